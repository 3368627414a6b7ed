// One block of threads per block of voxels; the other launches are one thread per pixel, point or ray.
#include "core/cuda_check.cuh"
#include "kernels/depth_planes.h"
#include "launch/tsdf.h"

namespace spslam {
namespace {

constexpr int kIntegrateThreads = 128;

__global__ void __launch_bounds__(kIntegrateThreads)
    integrate_kernel(TsdfBlocks blocks, PlaneFrame frame, TsdfOptions options, const float* tiles_far) {
  const Pose<float> pose = load_pose(frame.pose);
  for (std::int64_t row = blockIdx.x; row < blocks.count; row += gridDim.x) {
    const BlockInCamera block = block_in_camera(pose, blocks.coords + 3 * row, blocks.voxel_size);
    if (!block_in_view(frame, block, tiles_far, options.truncation)) continue;  // the same for all threads
    for (int m = threadIdx.x; m < kTsdfBlockVoxels; m += kIntegrateThreads) {
      const float i = static_cast<float>(m / (kTsdfBlockSide * kTsdfBlockSide));
      const float j = static_cast<float>(m / kTsdfBlockSide % kTsdfBlockSide);
      const float k = static_cast<float>(m % kTsdfBlockSide);
      const Vec3<float> at = block.first + i * block.i + j * block.j + k * block.k;
      const std::int32_t pixel = pixel_at(frame, at);
      if (pixel < 0) continue;
      const MeasuredPlane plane = load_plane(frame.planes + static_cast<std::int64_t>(kPlaneSize) * pixel);
      const TsdfObservation seen = observe_voxel(plane, at, options, pixel);
      if (!(seen.weight > 0.0f)) continue;
      const std::int64_t place = kTsdfBlockVoxels * row + m;
      update_voxel(seen, options.max_weight, blocks.sdf[place], blocks.weights[place]);
      if (takes_color(frame, seen, blocks.voxel_size)) {
        update_color(frame, seen, at.z, blocks.voxel_size, blocks.colors + kTsdfColorSize * place);
      }
    }
  }
}

}  // namespace

template <>
void measure_planes<Cuda>(Cuda device, const DepthImage& image, const DepthNoise& noise, float* planes) {
  const std::int64_t pixels = static_cast<std::int64_t>(image.width) * image.height;
  for_each(device, pixels, [=] __device__(std::int64_t i) {
    const std::int32_t u = static_cast<std::int32_t>(i % image.width), v = static_cast<std::int32_t>(i / image.width);
    const auto inverse_at = [&](int du, int dv) {
      const bool inside = u + du >= 0 && v + dv >= 0 && u + du < image.width && v + dv < image.height;
      return inside ? inverse_depth(image.depth[i + static_cast<std::int64_t>(dv) * image.width + du]) : 0.0f;
    };
    const float center = inverse_at(0, 0);
    const PlaneMiddle middle =
        plane_middle(noise, image.camera, center, one_sided_slope(inverse_at(-1, 0), center, inverse_at(1, 0)),
                     one_sided_slope(inverse_at(0, -1), center, inverse_at(0, 1)));
    PlaneSums sums{};
    for (int dv = -kPlaneRadius; dv <= kPlaneRadius; ++dv) {
      for (int du = -kPlaneRadius; du <= kPlaneRadius; ++du) {
        add_plane_sample(inverse_at(du, dv), middle, du, dv, plane_window_weight(du, dv), sums);
      }
    }
    const MeasuredPlane plane = fit_plane(sums, image.camera, noise, static_cast<float>(u), static_cast<float>(v),
                                          center, whole_plane_window());
    store_plane(plane, planes + kPlaneSize * i);
  });
}

template <>
void tsdf_integrate<Cuda>(Cuda device, const TsdfBlocks& blocks, const PlaneFrame& frame, const TsdfOptions& options,
                          void* workspace) {
  if (blocks.count == 0 || frame.width == 0 || frame.height == 0) return;
  constexpr std::int64_t kMostBlocks = 1 << 20;
  float* tiles_far = static_cast<float*>(workspace);
  measure_tiles(device, frame, tiles_far);
  const int grid = static_cast<int>(blocks.count < kMostBlocks ? blocks.count : kMostBlocks);
  integrate_kernel<<<grid, kIntegrateThreads, 0, static_cast<cudaStream_t>(device.stream)>>>(blocks, frame, options,
                                                                                             tiles_far);
  SPS_CUDA_CHECK(cudaGetLastError());
}

SPS_INSTANTIATE_TSDF(Cuda)

}  // namespace spslam
