// One block of threads per block of voxels, a warp per tile; the other launches are one thread per pixel, point or ray.
#include "core/cuda_check.cuh"
#include "cuda/warp_sums.cuh"
#include "kernels/depth_planes.h"
#include "launch/tsdf.h"

namespace spslam {
namespace {

constexpr int kIntegrateThreads = 128, kTileThreads = 128;

// Writes the blocks that a pixel touches, but those that its left neighbor's same sample touches too.
__device__ void write_touched(const PlaneFrame& frame, const Pose<float>& pose, float inverse_block_size,
                              const TouchOptions& options, int u, int v, std::int32_t* coords) {
  const int step = options.step;
  const auto ray_at = [&](int column) {
    const float* plane = frame.planes + kPlaneSize * (static_cast<std::int64_t>(v) * frame.width + column);
    return touched_ray(load_plane(plane), frame.camera, options, static_cast<float>(column), static_cast<float>(v));
  };
  const TouchedRay own = ray_at(u), left = u >= step ? ray_at(u - step) : TouchedRay{{0, 0, 0}, {0, 0, 0}, false};
  const auto block = [&](const TouchedRay& ray, int k) {
    return ray.known ? touched_block(ray.first, ray.step, k, pose, inverse_block_size) : VoxelCoord{kNoBlock, 0, 0};
  };
  VoxelCoord before{kNoBlock, 0, 0};
  for (int k = 0; k < kTouchedPerPixel; ++k) {
    const VoxelCoord at = block(own, k);
    const bool known = same_block(at, before) || same_block(at, block(left, k));
    before = at;
    coords[3 * k] = known ? kNoBlock : at.x;
    coords[3 * k + 1] = known ? 0 : at.y;
    coords[3 * k + 2] = known ? 0 : at.z;
  }
}

// The farthest surface (m) in each tile of the image, 0 without any; a warp for each.
__global__ void __launch_bounds__(kTileThreads) measure_tiles(PlaneFrame frame, int columns, int tiles, float* far) {
  const int tile = static_cast<int>((blockIdx.x * kTileThreads + threadIdx.x) / kWarp), lane = threadIdx.x % kWarp;
  if (tile >= tiles) return;
  const int first_u = tile % columns * kTsdfTileSide, first_v = tile / columns * kTsdfTileSide;
  float most = 0.0f;
  for (int m = lane; m < kTsdfTileSide * kTsdfTileSide; m += kWarp) {
    const int u = first_u + m % kTsdfTileSide, v = first_v + m / kTsdfTileSide;
    if (u >= frame.width || v >= frame.height) continue;
    const float* plane = frame.planes + kPlaneSize * (static_cast<std::int64_t>(v) * frame.width + u);
    most = larger(plane_depth(load_plane(plane), frame.camera, static_cast<float>(u), static_cast<float>(v)), most);
  }
  for (int step = kWarp / 2; step > 0; step /= 2) most = larger(most, __shfl_xor_sync(kAllLanes, most, step));
  if (lane == 0) far[tile] = most;
}

// Adds a pixel's color to a voxel at a depth.
__device__ void update_color(const PlaneFrame& frame, std::int32_t pixel, float depth, float voxel_size,
                             std::uint16_t* color) {
  const std::uint8_t* rgb = frame.colors + 3 * static_cast<std::int64_t>(pixel);
  const ColorSample seen{static_cast<float>(rgb[0]), static_cast<float>(rgb[1]), static_cast<float>(rgb[2]),
                         frame.planes[static_cast<std::int64_t>(kPlaneSize) * pixel + 4]};
  const ColorUnits mean =
      mix_colors({color[0], color[1], color[2], color[3]}, seen, frame.camera.fx * voxel_size / depth);
  color[0] = static_cast<std::uint16_t>(mean.red);
  color[1] = static_cast<std::uint16_t>(mean.green);
  color[2] = static_cast<std::uint16_t>(mean.blue);
  color[3] = static_cast<std::uint16_t>(mean.weight);
}

__global__ void __launch_bounds__(kIntegrateThreads)
    integrate_kernel(TsdfBlocks blocks, PlaneFrame frame, TsdfOptions options, const float* tiles_far) {
  const Pose<float> pose = load_pose(frame.pose);
  for (std::int64_t row = blockIdx.x; row < blocks.count; row += gridDim.x) {
    const BlockInCamera block = block_in_camera(pose, blocks.coords + 3 * row, blocks.voxel_size);
    if (!block_in_view(frame, block, tiles_far, options)) continue;  // the same for all threads
    for (int m = threadIdx.x; m < kTsdfBlockVoxels; m += kIntegrateThreads) {
      const float i = static_cast<float>(m / (kTsdfBlockSide * kTsdfBlockSide));
      const float j = static_cast<float>(m / kTsdfBlockSide % kTsdfBlockSide);
      const float k = static_cast<float>(m % kTsdfBlockSide);
      const Vec3<float> at = block.first + i * block.i + j * block.j + k * block.k;
      const std::int32_t pixel = pixel_at(frame, at);
      if (pixel < 0) continue;
      const MeasuredPlane plane = load_plane(frame.planes + static_cast<std::int64_t>(kPlaneSize) * pixel);
      const float distance = plane_distance(plane, at);
      const TsdfObservation seen =
          observe_voxel(plane.distance, plane.weight, distance, at.z, blocks.voxel_size, options);
      if (!(seen.weight > 0.0f)) continue;
      const std::int64_t place = kTsdfBlockVoxels * row + m;
      update_voxel(seen, options.max_weight, blocks.sdf[place], blocks.weights[place]);
      if (frame.colors && takes_color(seen.weight, distance, blocks.voxel_size)) {
        update_color(frame, pixel, at.z, blocks.voxel_size, blocks.colors + kTsdfColorSize * place);
      }
    }
  }
}

}  // namespace

template <>
void measure_planes<Cuda>(Cuda device, const DepthImage& image, const PlaneNoise& noise, float* planes) {
  const std::int64_t pixels = static_cast<std::int64_t>(image.width) * image.height;
  for_each(device, pixels, [=] __device__(std::int64_t i) {
    const std::int32_t u = static_cast<std::int32_t>(i % image.width), v = static_cast<std::int32_t>(i / image.width);
    const auto inverse_at = [&](int du, int dv) {
      const bool inside = u + du >= 0 && v + dv >= 0 && u + du < image.width && v + dv < image.height;
      return inside ? inverse_depth(image.depth[i + static_cast<std::int64_t>(dv) * image.width + du])
                    : kUnknownInverse;
    };
    const float center = inverse_at(0, 0);
    const PlaneMiddle middle = plane_middle(own_noise(noise), image.camera, center,
                                            one_sided_slope(inverse_at(-1, 0), center, inverse_at(1, 0)),
                                            one_sided_slope(inverse_at(0, -1), center, inverse_at(0, 1)));
    PlaneSums sums{};
    SPS_UNROLL for (int dv = -kPlaneRadius; dv <= kPlaneRadius; ++dv) {
      add_plane_row(middle, dv, inverse_at(-2, dv), inverse_at(-1, dv), inverse_at(0, dv), inverse_at(1, dv),
                    inverse_at(2, dv), sums);
    }
    const MeasuredPlane plane = fit_plane(sums, image.camera, noise.depth, own_noise(noise), static_cast<float>(u),
                                          static_cast<float>(v), center);
    store_plane(plane, planes + kPlaneSize * i);
  });
}

template <>
std::int64_t tsdf_touched_blocks<Cuda>(Cuda device, const PlaneFrame& frame, const TouchOptions& options,
                                       std::int32_t* coords) {
  const std::int32_t step = options.step;
  const std::int64_t columns = (frame.width + step - 1) / step, rows = touched_rows(frame, step);
  const float inverse_block_size = 1.0f / (kTsdfBlockSide * options.voxel_size);
  for_each(device, rows / kTouchedPerPixel, [=] __device__(std::int64_t i) {
    const int u = static_cast<int>(i % columns) * step, v = static_cast<int>(i / columns) * step;
    write_touched(frame, load_pose(frame.pose), inverse_block_size, options, u, v, coords + 3 * kTouchedPerPixel * i);
  });
  return rows;
}

template <>
std::int64_t tsdf_missing_blocks<Cuda>(Cuda device, const VoxelTable& table, const std::int32_t* coords, std::int64_t n,
                                       void* workspace, std::int32_t* missing) {
  const cudaStream_t stream = static_cast<cudaStream_t>(device.stream);
  std::int32_t* count = static_cast<std::int32_t*>(workspace);
  SPS_CUDA_CHECK(cudaMemsetAsync(count, 0, sizeof(*count), stream));
  const VoxelTable known = table;
  for_each(device, n, [=] __device__(std::int64_t i) {
    const VoxelCoord at = load_voxel(coords, i);
    if (!is_missing_block(known, at)) return;
    std::int32_t* out = missing + 3 * static_cast<std::int64_t>(atomicAdd(count, 1));
    out[0] = at.x, out[1] = at.y, out[2] = at.z;
  });
  std::int32_t found = 0;
  SPS_CUDA_CHECK(cudaMemcpyAsync(&found, count, sizeof(found), cudaMemcpyDeviceToHost, stream));
  SPS_CUDA_CHECK(cudaStreamSynchronize(stream));
  return found;
}

template <>
void tsdf_integrate<Cuda>(Cuda device, const TsdfBlocks& blocks, const PlaneFrame& frame, const TsdfOptions& options,
                          void* workspace) {
  if (blocks.count == 0 || frame.width == 0 || frame.height == 0) return;
  constexpr std::int64_t kMostBlocks = 1 << 20;
  float* tiles_far = static_cast<float*>(workspace);
  const cudaStream_t stream = static_cast<cudaStream_t>(device.stream);
  const int columns = tiles_along(frame.width), tiles = columns * tiles_along(frame.height);
  constexpr int kTilesPerBlock = kTileThreads / kWarp;
  measure_tiles<<<(tiles + kTilesPerBlock - 1) / kTilesPerBlock, kTileThreads, 0, stream>>>(frame, columns, tiles,
                                                                                            tiles_far);
  const int grid = static_cast<int>(blocks.count < kMostBlocks ? blocks.count : kMostBlocks);
  integrate_kernel<<<grid, kIntegrateThreads, 0, stream>>>(blocks, frame, options, tiles_far);
  SPS_CUDA_CHECK(cudaGetLastError());
}

SPS_INSTANTIATE_TSDF(Cuda)

}  // namespace spslam
