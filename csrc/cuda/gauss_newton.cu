// Two launches an iteration: blocks of pixels to partial sums, and one warp that adds them in order and moves the pose.
#include <cuda_runtime.h>

#include "kernels/gauss_newton.h"
#include "kernels/scene_element.h"
#include "spslam/gauss_newton.h"

namespace spslam {
namespace {

constexpr int kPixelThreads = 64;

__host__ __device__ std::int64_t block_count(std::int64_t pixels) {
  return (pixels + kPixelThreads - 1) / kPixelThreads;
}

// Which record pixel i of frame f is: drawn by Philox while tracking, the i-th of the frame otherwise.
struct PixelSource {
  const std::int32_t* pixels;
  std::int64_t num_records, pixels_per_frame;
  bool drawn;
  PhiloxKey key;

  __device__ const std::int32_t* record(std::int64_t frame, std::int64_t i) const {
    const std::int64_t at =
        drawn ? philox_index(key, static_cast<std::uint32_t>(i), num_records) : frame * pixels_per_frame + i;
    return pixels + kPixelWords * at;
  }
};

// partials[(frame * blocks + block) * kTrackingTerms]: sums over the block's pixels, lanes added in a fixed tree.
__global__ void residual_kernel(SceneView scene, PixelSource source, const float* poses, Intrinsics camera,
                                float truncation, float kernel, double* partials) {
  __shared__ double sums[kPixelThreads];
  const std::int64_t frame = blockIdx.y, i = blockIdx.x * std::int64_t{kPixelThreads} + threadIdx.x;
  double terms[kTrackingTerms] = {};
  if (i < source.pixels_per_frame) {
    const Pixel pixel = unpack_pixel(source.record(frame, i));
    const SurfacePoint point =
        surface_point(pixel, load_pose(poses + kPoseSize * frame), camera.fx, camera.fy, camera.cx, camera.cy);
    const Cell<float> cell = find_cell(scene.table, scene.corner_ids, (1.0f / scene.voxel_size) * point.world);
    if (pixel.depth > 0.0f && cell.corner_ids) {
      Vec3<float> gradient;
      const float sdf = geometry_element(scene, point.world, cell, &gradient);
      if (is_tracking_inlier(pixel.depth, true, sdf)) {
        add_tracking_residual(point.offset, sdf, gradient, truncation, kernel, terms);
      }
    }
  }
  double* out = partials + (frame * gridDim.x + blockIdx.x) * kTrackingTerms;
  for (int t = 0; t < kTrackingTerms; ++t) {
    sums[threadIdx.x] = terms[t];
    __syncthreads();
    for (int width = kPixelThreads / 2; width > 0; width /= 2) {
      if (threadIdx.x < width) sums[threadIdx.x] += sums[threadIdx.x + width];
      __syncthreads();
    }
    if (threadIdx.x == 0) out[t] = sums[0];
    __syncthreads();
  }
}

// Lane t adds term t of all blocks, in order.
__device__ void add_partials(const double* partials, std::int64_t blocks, double* terms) {
  if (threadIdx.x < kTrackingTerms) {
    double sum = 0.0;
    for (std::int64_t b = 0; b < blocks; ++b) sum += partials[b * kTrackingTerms + threadIdx.x];
    terms[threadIdx.x] = sum;
  }
  __syncwarp();
}

__global__ void tracking_step_kernel(const double* partials, std::int64_t blocks, double damping,
                                     std::int64_t num_pixels, float* pose, float* stats, float* hessian) {
  __shared__ double terms[kTrackingTerms];
  add_partials(partials, blocks, terms);
  if (threadIdx.x == 0) tracking_step(terms, damping, num_pixels, pose, stats, hessian);
}

__global__ void store_kernel(const double* partials, std::int64_t blocks, std::int64_t num_pixels, float* hessian,
                             float* gradient, float* cost, float* inliers) {
  __shared__ double terms[kTrackingTerms];
  const std::int64_t frame = blockIdx.x;
  add_partials(partials + frame * blocks * kTrackingTerms, blocks, terms);
  if (threadIdx.x != 0) return;
  double h[36], g[6], total;
  store_normal_terms<double>(terms, h, g, &total);
  for (int i = 0; i < 36; ++i) hessian[36 * frame + i] = static_cast<float>(h[i]);
  for (int i = 0; i < 6; ++i) gradient[6 * frame + i] = static_cast<float>(g[i]);
  cost[frame] = static_cast<float>(tracking_cost(terms));
  inliers[frame] = num_pixels ? static_cast<float>(terms[kNormalTerms + 1] / static_cast<double>(num_pixels)) : 0.0f;
}

}  // namespace

template <>
std::int64_t gauss_newton_workspace_size<Cuda>(Cuda, std::int64_t frames, std::int64_t pixels) {
  const std::int64_t blocks = block_count(pixels);
  return (frames > 0 ? frames : 1) * (blocks > 0 ? blocks : 1) * kTrackingTerms *
         static_cast<std::int64_t>(sizeof(double));
}

template <>
void track_gauss_newton<Cuda>(Cuda device, const SceneView& scene, const std::int32_t* pixels, std::int64_t num_records,
                              const TrackingOptions& options, void* workspace, float* pose, float* stats,
                              float* hessian) {
  const cudaStream_t stream = static_cast<cudaStream_t>(device.stream);
  double* partials = static_cast<double*>(workspace);
  const std::int64_t blocks = block_count(options.num_pixels);
  for (std::int64_t iteration = 0; iteration < options.iterations; ++iteration) {
    PixelSource source{pixels, num_records, options.num_pixels, true, options.key};
    source.key.iteration = static_cast<std::uint32_t>(iteration);
    const float kernel = annealed_kernel(options.kernel_start, options.kernel_end, iteration, options.iterations);
    residual_kernel<<<static_cast<unsigned>(blocks), kPixelThreads, 0, stream>>>(
        scene, source, pose, options.intrinsics, options.truncation, kernel, partials);
    tracking_step_kernel<<<1, 32, 0, stream>>>(partials, blocks, options.damping, options.num_pixels, pose,
                                               stats + kTrackingStatSize * iteration, hessian);
  }
}

template <>
void gauss_newton_poses<Cuda>(Cuda device, const SceneView& scene, const std::int32_t* pixels, const float* poses,
                              std::int64_t frames, std::int64_t pixels_per_frame, const Intrinsics& intrinsics,
                              float truncation, float kernel, void* workspace, float* hessian, float* gradient,
                              float* cost, float* inliers) {
  if (frames == 0) return;
  const cudaStream_t stream = static_cast<cudaStream_t>(device.stream);
  double* partials = static_cast<double*>(workspace);
  const std::int64_t blocks = block_count(pixels_per_frame);
  const PixelSource source{pixels, frames * pixels_per_frame, pixels_per_frame, false, {}};
  if (blocks > 0) {
    const dim3 grid(static_cast<unsigned>(blocks), static_cast<unsigned>(frames));
    residual_kernel<<<grid, kPixelThreads, 0, stream>>>(scene, source, poses, intrinsics, truncation, kernel, partials);
  }
  store_kernel<<<static_cast<unsigned>(frames), 32, 0, stream>>>(partials, blocks, pixels_per_frame, hessian, gradient,
                                                                 cost, inliers);
}

}  // namespace spslam
