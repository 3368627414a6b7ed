#include "launch/tsdf.h"

#include <algorithm>
#include <cstring>

#include "cpu/plane_lanes.h"

namespace spslam {
namespace {

constexpr std::int64_t kBlockGrain = 16, kTileGrain = 1;
// Voxels of a block with the same first coordinate, which are worked on together, and pixels.
constexpr int kVoxelLanes = kTsdfBlockSide * kTsdfBlockSide, kPixelLanes = 64;
static_assert(kPixelLanes % kTsdfTileSide == 0, "a batch of pixels must end where a tile does");

// Raises the farthest surface of tiles to that of the pixels [first, first + kPixelLanes) of row v that there are.
void measure_batch(const PlaneFrame& frame, std::int64_t v, std::int32_t first, float* tiles_far) {
  const std::int32_t count = frame.width - first;
  PlaneLanes<kPixelLanes> planes;
  planes.load(frame.planes, [&](int m) { return m < count ? v * frame.width + first + m : -1; });
  alignas(64) float depth[kPixelLanes];
  const Intrinsics camera = frame.camera;
  const float row = static_cast<float>(v);
  SPS_SIMD for (int m = 0; m < kPixelLanes; ++m) {
    depth[m] = plane_depth(planes[m], camera, static_cast<float>(first + m), row);
  }
  // Lanes without a pixel have depth 0.
  for (int begin = 0; begin < std::min(count, kPixelLanes); begin += kTsdfTileSide) {
    float& tile = tiles_far[(first + begin) / kTsdfTileSide];
    float far = tile;
#pragma omp simd reduction(max : far)
    for (int m = 0; m < kTsdfTileSide; ++m) far = depth[begin + m] > far ? depth[begin + m] : far;
    tile = far;
  }
}

// The farthest surface (m) in each tile of the image; 0 without any.
void measure_tiles(const PlaneFrame& frame, float* tiles_far) {
  const std::int32_t columns = tiles_along(frame.width);
  parallel_for(tiles_along(frame.height), kTileGrain, [&](std::int64_t begin, std::int64_t end) {
    std::fill(tiles_far + begin * columns, tiles_far + end * columns, 0.0f);
    const std::int64_t last = std::min<std::int64_t>(end * kTsdfTileSide, frame.height);
    for (std::int64_t v = begin * kTsdfTileSide; v < last; ++v) {
      float* tiles = tiles_far + v / kTsdfTileSide * columns;
      for (std::int32_t first = 0; first < frame.width; first += kPixelLanes) measure_batch(frame, v, first, tiles);
    }
  });
}

// Camera axes of the voxels with first coordinate i of a block, one array per axis, and the pixels that they fall on.
struct VoxelSlice {
  alignas(64) float x[kVoxelLanes], y[kVoxelLanes], z[kVoxelLanes];
  alignas(64) std::int32_t pixels[kVoxelLanes];

  // Returns whether any falls on a pixel. Not inlined, as sums that are contracted in another order around it would
  // move voxels between pixels.
  __attribute__((noinline)) bool place(const BlockInCamera& block, int i, const PlaneFrame& frame) {
    const Vec3<float> first = block.first + static_cast<float>(i) * block.i;
    for (int j = 0; j < kTsdfBlockSide; ++j) {
      const Vec3<float> row = first + static_cast<float>(j) * block.j;
      SPS_SIMD for (int k = 0; k < kTsdfBlockSide; ++k) {
        x[kTsdfBlockSide * j + k] = row.x + static_cast<float>(k) * block.k.x;
        y[kTsdfBlockSide * j + k] = row.y + static_cast<float>(k) * block.k.y;
        z[kTsdfBlockSide * j + k] = row.z + static_cast<float>(k) * block.k.z;
      }
    }
    // A copy, as what the loop writes might else be part of what it reads.
    const PlaneFrame view = frame;
    std::int32_t last = -1;
#pragma omp simd reduction(max : last)
    for (int m = 0; m < kVoxelLanes; ++m) {
      const std::int32_t pixel = pixel_at(view, {x[m], y[m], z[m]});
      pixels[m] = pixel;
      last = pixel > last ? pixel : last;
    }
    if (last < 0) return false;
    for (int m = 0; m < kVoxelLanes; ++m) {
      __builtin_prefetch(frame.planes + kPlaneSize * static_cast<std::int64_t>(pixels[m] < 0 ? last : pixels[m]));
    }
    return true;
  }
};

// Voxels of a block that take a color. A color and its weight are four times 16 bits in memory.
struct ColoredVoxels {
  alignas(64) std::int32_t places[kTsdfBlockVoxels], pixels[kTsdfBlockVoxels];
  alignas(64) float certainty[kTsdfBlockVoxels], depth[kTsdfBlockVoxels];
  alignas(64) float red[kTsdfBlockVoxels], green[kTsdfBlockVoxels], blue[kTsdfBlockVoxels];
  alignas(64) std::uint32_t red_green[kTsdfBlockVoxels], blue_weight[kTsdfBlockVoxels];
  int count = 0;

  // Appends the voxels of slice i where `takes`, and asks for the memory that they will need.
  void append(int i, const VoxelSlice& at, const float* plane_weights, const std::int32_t* takes,
              const PlaneFrame& frame, const std::uint16_t* colors) {
    int end = count;
    for (int m = 0; m < kVoxelLanes; ++m) {
      places[end] = m;
      end += takes[m];
    }
    for (int n = count; n < end; ++n) {
      const int m = places[n];
      places[n] = kVoxelLanes * i + m;
      pixels[n] = at.pixels[m];
      certainty[n] = plane_weights[m];
      depth[n] = at.z[m];
      __builtin_prefetch(colors + kTsdfColorSize * places[n], 1);
      __builtin_prefetch(frame.colors + 3 * static_cast<std::int64_t>(pixels[n]));
    }
    count = end;
  }

  // Adds a frame to their colors, those of the block being [512, 4].
  void update(const PlaneFrame& frame, float voxel_size, std::uint16_t* colors) {
    for (int n = 0; n < count; ++n) {
      const std::uint16_t* mean = colors + kTsdfColorSize * places[n];
      const std::uint8_t* rgb = frame.colors + 3 * static_cast<std::int64_t>(pixels[n]);
      red_green[n] = static_cast<std::uint32_t>(mean[0]) | static_cast<std::uint32_t>(mean[1]) << 16;
      blue_weight[n] = static_cast<std::uint32_t>(mean[2]) | static_cast<std::uint32_t>(mean[3]) << 16;
      red[n] = rgb[0];
      green[n] = rgb[1];
      blue[n] = rgb[2];
    }
    const float focal = frame.camera.fx;
    const int voxels = count;
    SPS_SIMD for (int n = 0; n < voxels; ++n) {
      const std::uint32_t low = red_green[n], high = blue_weight[n];
      const ColorUnits before{static_cast<std::int32_t>(low & 0xFFFF), static_cast<std::int32_t>(low >> 16),
                              static_cast<std::int32_t>(high & 0xFFFF), static_cast<std::int32_t>(high >> 16)};
      const ColorSample seen{red[n], green[n], blue[n], certainty[n]};
      const ColorUnits mean = mix_colors(before, seen, focal * voxel_size / depth[n]);
      red_green[n] = static_cast<std::uint32_t>(mean.red) | static_cast<std::uint32_t>(mean.green) << 16;
      blue_weight[n] = static_cast<std::uint32_t>(mean.blue) | static_cast<std::uint32_t>(mean.weight) << 16;
    }
    for (int n = 0; n < count; ++n) {
      std::uint16_t* to = colors + kTsdfColorSize * places[n];
      to[0] = static_cast<std::uint16_t>(red_green[n]);
      to[1] = static_cast<std::uint16_t>(red_green[n] >> 16);
      to[2] = static_cast<std::uint16_t>(blue_weight[n]);
      to[3] = static_cast<std::uint16_t>(blue_weight[n] >> 16);
    }
  }
};

// Distances of the voxels of a slice from the planes of their pixels, and of these from the camera, 0 where there is
// none; returns whether a voxel has a plane that it lies before, or at most `reach` behind.
bool measure_slice(const VoxelSlice& at, const PlaneFrame& frame, float reach, float* distance, float* from_camera) {
  static constexpr float kNothing[4] = {};
  // Normal and distance are copied as one vector: gathers of vectors are slower on many processors.
  alignas(64) float planes[4 * kVoxelLanes];
  for (int m = 0; m < kVoxelLanes; ++m) {
    const std::int64_t pixel = at.pixels[m];
    std::memcpy(planes + 4 * m, pixel < 0 ? kNothing : frame.planes + kPlaneSize * pixel, sizeof kNothing);
  }
  std::int32_t any = 0;
#pragma omp simd reduction(| : any)
  for (int m = 0; m < kVoxelLanes; ++m) {
    const MeasuredPlane plane{{planes[4 * m], planes[4 * m + 1], planes[4 * m + 2]}, planes[4 * m + 3], 1.0f};
    const float own = plane_distance(plane, {at.x[m], at.y[m], at.z[m]}), away = planes[4 * m + 3];
    const std::int32_t near = (own > -reach) & (away > 0.0f) ? 1 : 0;
    distance[m] = own;
    from_camera[m] = away;
    any |= near;
  }
  return any != 0;
}

// Adds a frame to the distances of slice i of a block; its voxels that take a color are appended. No truncation there
// is larger than `reach`.
void integrate_slice(const TsdfBlocks& blocks, std::int64_t row, int i, const VoxelSlice& at, const PlaneFrame& frame,
                     const TsdfOptions& options, float reach, ColoredVoxels& colored_voxels) {
  alignas(64) float distance[kVoxelLanes], from_camera[kVoxelLanes], plane_weight[kVoxelLanes];
  if (!measure_slice(at, frame, reach, distance, from_camera)) return;
  for (int m = 0; m < kVoxelLanes; ++m) {
    plane_weight[m] = at.pixels[m] < 0 ? 0.0f : frame.planes[kPlaneSize * std::int64_t{at.pixels[m]} + 4];
  }
  const TsdfOptions seen_with = options;
  const float voxel_size = blocks.voxel_size;
  const float* depth = at.z;
  alignas(64) float sdf[kVoxelLanes], weight[kVoxelLanes];
  alignas(64) std::int32_t takes[kVoxelLanes];
  std::int32_t any = 0;
#pragma omp simd reduction(| : any)
  for (int m = 0; m < kVoxelLanes; ++m) {
    const TsdfObservation seen =
        observe_voxel(from_camera[m], plane_weight[m], distance[m], depth[m], voxel_size, seen_with);
    const float seen_sdf = seen.sdf, seen_weight = seen.weight;
    const std::int32_t colored = takes_color(seen_weight, distance[m], voxel_size);
    sdf[m] = seen_sdf;
    weight[m] = seen_weight;
    takes[m] = colored;
    any |= colored;
  }
  const std::int64_t place = kTsdfBlockVoxels * row + kVoxelLanes * i;
  float *to_sdf = blocks.sdf + place, *to_weight = blocks.weights + place;
  SPS_SIMD for (int m = 0; m < kVoxelLanes; ++m) {
    update_voxel({sdf[m], weight[m]}, seen_with.max_weight, to_sdf[m], to_weight[m]);
  }
  if (!any || !frame.colors) return;
  colored_voxels.append(i, at, plane_weight, takes, frame, blocks.colors + kTsdfColorSize * kTsdfBlockVoxels * row);
}

// Adds a frame to a block.
void integrate_block(const TsdfBlocks& blocks, std::int64_t row, const BlockInCamera& block, const PlaneFrame& frame,
                     const TsdfOptions& options) {
  VoxelSlice slices[kTsdfBlockSide];
  bool seen[kTsdfBlockSide];
  for (int i = 0; i < kTsdfBlockSide; ++i) seen[i] = slices[i].place(block, i, frame);
  const float farthest = block.first.z + (kTsdfBlockSide - 1) * std::sqrt(3.0f * dot(block.i, block.i));
  const float reach = noisy_truncation(options.truncation, std::sqrt(depth_variance(options.noise, farthest)));
  ColoredVoxels colored;
  for (int i = 0; i < kTsdfBlockSide; ++i) {
    if (seen[i]) integrate_slice(blocks, row, i, slices[i], frame, options, reach, colored);
  }
  colored.update(frame, blocks.voxel_size, blocks.colors + kTsdfColorSize * kTsdfBlockVoxels * row);
}

}  // namespace

template <>
void tsdf_integrate<Cpu>(Cpu, const TsdfBlocks& blocks, const PlaneFrame& frame, const TsdfOptions& options,
                         void* workspace) {
  if (frame.width == 0 || frame.height == 0) return;
  float* tiles_far = static_cast<float*>(workspace);
  measure_tiles(frame, tiles_far);
  const Pose<float> pose = load_pose(frame.pose);
  parallel_for(blocks.count, kBlockGrain, [&](std::int64_t begin, std::int64_t end) {
    for (std::int64_t row = begin; row < end; ++row) {
      const BlockInCamera block = block_in_camera(pose, blocks.coords + 3 * row, blocks.voxel_size);
      if (!block_in_view(frame, block, tiles_far, options)) continue;
      integrate_block(blocks, row, block, frame, options);
    }
  });
}

SPS_INSTANTIATE_TSDF(Cpu)

}  // namespace spslam
