// One block per pair: all iterations in one launch, as a pair's pixels are few and its sums need no other block.
#include "core/cuda_check.cuh"
#include "cuda/warp_sums.cuh"
#include "kernels/depth_image_alignment.h"

namespace spslam {
namespace {

constexpr int kWarps = 8;
constexpr int kThreads = kWarps * kWarp;
static_assert(kKeyframeTerms <= kWarp && kComparisonTerms <= kWarp, "one lane per term");

// What the threads of a pair share.
struct PairMemory {
  EarlierFrames target;
  float sums[kWarps][kWarp];
  double terms[kWarp];
  float pose[kPoseSize];
};

// shared.terms = sums over the block of each thread's terms [kWarp].
__device__ void sum_block(float (&terms)[kWarp], PairMemory& shared) {
  const int lane = threadIdx.x % kWarp;
  shared.sums[threadIdx.x / kWarp][lane] = transpose_sum(terms, lane);
  __syncthreads();
  if (threadIdx.x < kWarp) {
    double sum = 0.0;
    for (int w = 0; w < kWarps; ++w) sum += static_cast<double>(shared.sums[w][threadIdx.x]);
    shared.terms[threadIdx.x] = sum;
  }
  __syncthreads();
}

__device__ void load_shared(const GaussNewtonOptions& options, const ImagePair& pair, const float* pose,
                            PairMemory& shared) {
  if (threadIdx.x == 0) load_target(options, pair.target, shared.target);
  if (threadIdx.x < kPoseSize) shared.pose[threadIdx.x] = pose[threadIdx.x];
  __syncthreads();
}

__global__ void __launch_bounds__(kThreads)
    align_kernel(PixelSets pixels, const std::int64_t* numbers, ImagePairs pairs, std::int64_t images,
                 const __grid_constant__ GaussNewtonOptions options, float* poses) {
  __shared__ PairMemory shared;
  const ImagePair pair = load_pair(pairs, blockIdx.x, pixels.count, images);
  if (!pair.exists) return;
  float* pose = poses + kPoseSize * std::int64_t{blockIdx.x};
  load_shared(options, pair, pose, shared);
  const std::int32_t* records = pixels.records + pair.source * pixels.pixels_per_set * kPixelWords;
  PhiloxKey key = options.key;
  key.frame = static_cast<std::uint32_t>(numbers[pair.source]);
  for (std::int64_t iteration = 0; iteration < options.iterations; ++iteration) {
    key.iteration = static_cast<std::uint32_t>(iteration);
    const Measurement measure = measurement(options, &shared.target, iteration);
    const Pose<float> at = load_pose(shared.pose);
    float terms[kWarp] = {};
    for (std::int64_t drawn = threadIdx.x; drawn < options.num_pixels; drawn += kThreads) {
      const std::int64_t row =
          philox_index(key, static_cast<std::uint32_t>(drawn), static_cast<std::uint64_t>(pixels.pixels_per_set));
      add_alignment_residuals(measure, records + kPixelWords * row, at, terms);
    }
    sum_block(terms, shared);
    if (threadIdx.x == 0) alignment_step(shared.terms, options.damping, shared.pose);
    __syncthreads();
  }
  if (threadIdx.x < kPoseSize) pose[threadIdx.x] = shared.pose[threadIdx.x];
}

__global__ void __launch_bounds__(kThreads)
    compare_kernel(PixelSets pixels, const float* normals, ImagePairs pairs, std::int64_t images,
                   const __grid_constant__ GaussNewtonOptions options, ComparisonOptions comparison, const float* poses,
                   double* sums) {
  __shared__ PairMemory shared;
  const ImagePair pair = load_pair(pairs, blockIdx.x, pixels.count, images);
  if (!pair.exists) return;
  load_shared(options, pair, poses + kPoseSize * std::int64_t{blockIdx.x}, shared);
  const Pose<float> pose = load_pose(shared.pose);
  const std::int64_t first = pair.source * pixels.pixels_per_set;
  float terms[kWarp] = {};
  for (std::int64_t pixel = threadIdx.x; pixel < pixels.pixels_per_set; pixel += kThreads) {
    add_comparison(options, shared.target, comparison, pixels.records + kPixelWords * (first + pixel),
                   normals + 3 * (first + pixel), pose, terms);
  }
  sum_block(terms, shared);
  if (threadIdx.x < kComparisonTerms) {
    sums[kComparisonTerms * std::int64_t{blockIdx.x} + threadIdx.x] = shared.terms[threadIdx.x];
  }
}

}  // namespace

template <>
void align_depth_images<Cuda>(Cuda device, const PixelSets& pixels, const std::int64_t* numbers,
                              const ImagePairs& pairs, std::int64_t images, const GaussNewtonOptions& options,
                              float* poses) {
  if (pairs.count == 0) return;
  align_kernel<<<static_cast<unsigned>(pairs.count), kThreads, 0, static_cast<cudaStream_t>(device.stream)>>>(
      pixels, numbers, pairs, images, options, poses);
  SPS_CUDA_CHECK(cudaGetLastError());
}

template <>
void compare_depth_images<Cuda>(Cuda device, const PixelSets& pixels, const float* normals, const ImagePairs& pairs,
                                std::int64_t images, const GaussNewtonOptions& options,
                                const ComparisonOptions& comparison, const float* poses, double* sums) {
  if (pairs.count == 0) return;
  compare_kernel<<<static_cast<unsigned>(pairs.count), kThreads, 0, static_cast<cudaStream_t>(device.stream)>>>(
      pixels, normals, pairs, images, options, comparison, poses, sums);
  SPS_CUDA_CHECK(cudaGetLastError());
}

}  // namespace spslam
