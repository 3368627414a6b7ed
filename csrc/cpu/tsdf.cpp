#include "launch/tsdf.h"

#include <algorithm>

#include "cpu/simd.h"
#include "kernels/depth_planes.h"

namespace spslam {
namespace {

constexpr std::int64_t kRowGrain = 8, kBlockGrain = 16;
// Pixels, and voxels, that are worked on together.
constexpr int kPixelLanes = 64, kVoxelLanes = kTsdfBlockSide * kTsdfBlockSide;

// Inverse depth with a border of unknown pixels as wide as the window reaches, and a whole batch on the right.
class InverseDepth {
 public:
  InverseDepth(ScratchBuffer<float>& buffer, const DepthImage& image)
      : stride_(image.width + 2 * kPlaneRadius + kPixelLanes) {
    const std::int64_t rows = image.height + 2 * kPlaneRadius;
    float* begin = buffer.reserve(rows * stride_);
    origin_ = begin + kPlaneRadius * (stride_ + 1);
    parallel_for(rows, kRowGrain, [&](std::int64_t first, std::int64_t last) {
      for (std::int64_t r = first; r < last; ++r) {
        float* row = begin + r * stride_;
        const std::int64_t v = r - kPlaneRadius;
        std::fill(row, row + stride_, 0.0f);
        if (v < 0 || v >= image.height) continue;
        const float* depth = image.depth + v * image.width;
        SPS_SIMD for (std::int32_t u = 0; u < image.width; ++u) row[kPlaneRadius + u] = inverse_depth(depth[u]);
      }
    });
  }

  const float* row(std::int64_t v) const { return origin_ + v * stride_; }

 private:
  std::int64_t stride_;
  const float* origin_;
};

// Planes of the pixels [first, first + kPixelLanes) of a row that lie in the image.
void planes_of_batch(const DepthImage& image, const InverseDepth& inverse, const DepthNoise& noise, std::int64_t v,
                     std::int32_t first, float* planes) {
  alignas(64) float by_u[kPixelLanes], by_v[kPixelLanes], gates[kPixelLanes];
  alignas(64) float sums[kPlaneSums][kPixelLanes] = {}, out[kPlaneSize][kPixelLanes];
  const float* centers = inverse.row(v) + first;
  const float *above = inverse.row(v - 1) + first, *below = inverse.row(v + 1) + first;
  const Intrinsics camera = image.camera;
  SPS_SIMD for (int i = 0; i < kPixelLanes; ++i) {
    const float slope_u = one_sided_slope(centers[i - 1], centers[i], centers[i + 1]);
    const float slope_v = one_sided_slope(above[i], centers[i], below[i]);
    const PlaneMiddle middle = plane_middle(noise, camera, centers[i], slope_u, slope_v);
    by_u[i] = middle.by_u;
    by_v[i] = middle.by_v;
    gates[i] = middle.inverse_gate;
  }
  for (int dv = -kPlaneRadius; dv <= kPlaneRadius; ++dv) {
    for (int du = -kPlaneRadius; du <= kPlaneRadius; ++du) {
      const float* q = inverse.row(v + dv) + first + du;
      const float window_weight = plane_window_weight(du, dv);
      SPS_SIMD for (int i = 0; i < kPixelLanes; ++i) {
        PlaneSums s{sums[0][i], sums[1][i], sums[2][i], sums[3][i], sums[4][i],
                    sums[5][i], sums[6][i], sums[7][i], sums[8][i], sums[9][i]};
        add_plane_sample(q[i], {centers[i], by_u[i], by_v[i], gates[i]}, du, dv, window_weight, s);
        sums[0][i] = s.one, sums[1][i] = s.u, sums[2][i] = s.v, sums[3][i] = s.uu, sums[4][i] = s.uv;
        sums[5][i] = s.vv, sums[6][i] = s.q, sums[7][i] = s.qu, sums[8][i] = s.qv, sums[9][i] = s.qq;
      }
    }
  }
  const float whole = whole_plane_window();
  const float row = static_cast<float>(v);
  SPS_SIMD for (int i = 0; i < kPixelLanes; ++i) {
    const PlaneSums s{sums[0][i], sums[1][i], sums[2][i], sums[3][i], sums[4][i],
                      sums[5][i], sums[6][i], sums[7][i], sums[8][i], sums[9][i]};
    const MeasuredPlane plane = fit_plane(s, camera, noise, static_cast<float>(first + i), row, centers[i], whole);
    out[0][i] = plane.normal.x;
    out[1][i] = plane.normal.y;
    out[2][i] = plane.normal.z;
    out[3][i] = plane.distance;
    out[4][i] = plane.weight;
  }
  const int count = std::min(kPixelLanes, image.width - first);
  float* to = planes + kPlaneSize * (v * image.width + first);
  for (int i = 0; i < count; ++i) {
    for (int c = 0; c < kPlaneSize; ++c) to[kPlaneSize * i + c] = out[c][i];
  }
}

// The planes of some pixels, one array per number. Copied one by one: gathers of vectors are slower on many processors.
struct PlaneLanes {
  alignas(64) float x[kVoxelLanes], y[kVoxelLanes], z[kVoxelLanes], distance[kVoxelLanes], weight[kVoxelLanes];

  void load(const float* planes, const std::int32_t* pixels) {
    static constexpr float kNothing[kPlaneSize] = {};
    for (int m = 0; m < kVoxelLanes; ++m) {
      const float* plane = pixels[m] < 0 ? kNothing : planes + static_cast<std::int64_t>(kPlaneSize) * pixels[m];
      x[m] = plane[0];
      y[m] = plane[1];
      z[m] = plane[2];
      distance[m] = plane[3];
      weight[m] = plane[4];
    }
  }
};

// Camera axes of the 64 voxels with first coordinate i of a block, one array per axis.
struct SlicePoints {
  alignas(64) float x[kVoxelLanes], y[kVoxelLanes], z[kVoxelLanes];

  SlicePoints(const BlockInCamera& block, int i) {
    const Vec3<float> first = block.first + static_cast<float>(i) * block.i;
    for (int j = 0; j < kTsdfBlockSide; ++j) {
      const Vec3<float> row = first + static_cast<float>(j) * block.j;
      SPS_SIMD for (int k = 0; k < kTsdfBlockSide; ++k) {
        x[kTsdfBlockSide * j + k] = row.x + static_cast<float>(k) * block.k.x;
        y[kTsdfBlockSide * j + k] = row.y + static_cast<float>(k) * block.k.y;
        z[kTsdfBlockSide * j + k] = row.z + static_cast<float>(k) * block.k.z;
      }
    }
  }
};

// Adds a frame to the voxels with first coordinate i of a block.
void integrate_slice(const TsdfBlocks& blocks, std::int64_t row, int i, const BlockInCamera& block,
                     const PlaneFrame& frame, const TsdfOptions& options) {
  const SlicePoints at(block, i);
  alignas(64) std::int32_t pixels[kVoxelLanes];
  // Copies, as what a loop writes might else be part of what it reads.
  const PlaneFrame view = frame;
  std::int32_t last_pixel = -1;
#pragma omp simd reduction(max : last_pixel)
  for (int m = 0; m < kVoxelLanes; ++m) {
    const std::int32_t pixel = pixel_at(view, {at.x[m], at.y[m], at.z[m]});
    pixels[m] = pixel;
    last_pixel = pixel > last_pixel ? pixel : last_pixel;
  }
  if (last_pixel < 0) return;
  PlaneLanes planes;
  planes.load(frame.planes, pixels);
  alignas(64) float sdf[kVoxelLanes], weight[kVoxelLanes];
  const TsdfOptions seen_with = options;
  float most = 0.0f, nearest = options.truncation;
#pragma omp simd reduction(max : most) reduction(min : nearest)
  for (int m = 0; m < kVoxelLanes; ++m) {
    const MeasuredPlane plane{{planes.x[m], planes.y[m], planes.z[m]}, planes.distance[m], planes.weight[m]};
    const TsdfObservation seen = observe_voxel(plane, {at.x[m], at.y[m], at.z[m]}, seen_with, 0);
    const float seen_sdf = seen.sdf, seen_weight = seen.weight;
    sdf[m] = seen_sdf;
    weight[m] = seen_weight;
    most = seen_weight > most ? seen_weight : most;
    const float near = seen_weight > 0.0f ? std::fabs(seen_sdf) : seen_with.truncation;
    nearest = near < nearest ? near : nearest;
  }
  if (!(most > 0.0f)) return;
  const std::int64_t place = kTsdfBlockVoxels * row + kVoxelLanes * i;
  float *to_sdf = blocks.sdf + place, *to_weight = blocks.weights + place;
  const float max_weight = options.max_weight;
  SPS_SIMD for (int m = 0; m < kVoxelLanes; ++m) {
    update_voxel({sdf[m], weight[m], 0}, max_weight, to_sdf[m], to_weight[m]);
  }
  if (!(nearest < kColorBand * blocks.voxel_size)) return;
  for (int m = 0; m < kVoxelLanes; ++m) {
    const TsdfObservation seen{sdf[m], weight[m], pixels[m]};
    if (!takes_color(frame, seen, blocks.voxel_size)) continue;
    update_color(frame, seen, at.z[m], blocks.voxel_size, blocks.colors + kTsdfColorSize * (place + m));
  }
}

}  // namespace

template <>
void measure_planes<Cpu>(Cpu, const DepthImage& image, const DepthNoise& noise, float* planes) {
  if (image.width == 0 || image.height == 0) return;
  ScratchBuffer<float> buffer;
  const InverseDepth inverse(buffer, image);
  parallel_for(image.height, kRowGrain, [&](std::int64_t begin, std::int64_t end) {
    for (std::int64_t v = begin; v < end; ++v) {
      for (std::int32_t u = 0; u < image.width; u += kPixelLanes) planes_of_batch(image, inverse, noise, v, u, planes);
    }
  });
}

template <>
void tsdf_integrate<Cpu>(Cpu device, const TsdfBlocks& blocks, const PlaneFrame& frame, const TsdfOptions& options,
                         void* workspace) {
  if (frame.width == 0 || frame.height == 0) return;
  float* tiles_far = static_cast<float*>(workspace);
  measure_tiles(device, frame, tiles_far);
  const Pose<float> pose = load_pose(frame.pose);
  parallel_for(blocks.count, kBlockGrain, [&](std::int64_t begin, std::int64_t end) {
    for (std::int64_t row = begin; row < end; ++row) {
      const BlockInCamera block = block_in_camera(pose, blocks.coords + 3 * row, blocks.voxel_size);
      if (!block_in_view(frame, block, tiles_far, options.truncation)) continue;
      for (int i = 0; i < kTsdfBlockSide; ++i) integrate_slice(blocks, row, i, block, frame, options);
    }
  });
}

SPS_INSTANTIATE_TSDF(Cpu)

}  // namespace spslam
