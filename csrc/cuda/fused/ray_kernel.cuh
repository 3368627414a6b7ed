// The ray kernel: one warp per ray, forward and backward pass in one kernel.
//
// Blocks take groups of rays in a fixed order and leave their sums in partials, to be added in the order of the blocks:
// where the scene is optimized the gradients of the decoders and the loss terms, where it is frozen the loss terms and
// the gradient of the one pose.
#pragma once

#include "cuda/fused/ray_warp.cuh"
#include "cuda/fused/weight_gradients.cuh"

namespace spslam::fused {

// Shared memory per block, by compute capability.
constexpr int shared_memory_of(int architecture) {
  if (architecture < kTensorArchitecture) return 64 * 1024;
  if (architecture == 800 || architecture == 870) return 163 * 1024;
  if (architecture < 900 || architecture >= 1200) return 99 * 1024;
  return 227 * 1024;
}

// Sums over the rays of a warp.
struct WarpSums {
  RayLosses<float> losses;
  float pose_gradient[kPoseGradientSize];  // where there is but one pose
};

// A block's shared memory: decoders, warps, and staged tiles where the scene is optimized.
template <Precision kPrecision, bool kTrain, int kWarps>
struct BlockMemory {
  alignas(16) float image[Image::size];
  WarpMemory warps[kWarps];
  WarpSums sums[kWarps];

  __device__ __forceinline__ Stage<kPrecision>* stage(int) { return nullptr; }
};
template <Precision kPrecision, int kWarps>
struct BlockMemory<kPrecision, true, kWarps> {
  alignas(16) float image[Image::size];
  Stage<kPrecision> stages[kWarps];
  TrainingMemory warps[kWarps];
  WarpSums sums[kWarps];
  int staged[kWarps];

  __device__ __forceinline__ Stage<kPrecision>* stage(int warp) { return stages + warp; }
};

// Warps of a block: as many as its shared memory holds, at most 8, which the registers allow.
template <Precision kPrecision, bool kTrain>
constexpr int warps_of(int architecture) {
  const int memory = shared_memory_of(architecture);
  if (sizeof(BlockMemory<kPrecision, kTrain, 8>) <= memory) return 8;
  if (sizeof(BlockMemory<kPrecision, kTrain, 4>) <= memory) return 4;
  if (sizeof(BlockMemory<kPrecision, kTrain, 2>) <= memory) return 2;
  return 1;
}

// Whether code of an architecture has this variant: one width each, and tensor cores where they are asked for.
template <Precision kPrecision, bool kTrain, int kWarps>
constexpr bool has_variant(int architecture) {
  return (kPrecision == Precision::kFp32 || architecture >= kTensorArchitecture) &&
         warps_of<kPrecision, kTrain>(architecture) == kWarps;
}

__device__ __forceinline__ RayLosses<float> sum_losses(const RayLosses<float>& l) {
  return {sum_warp(l.rgb), sum_warp(l.depth), sum_warp(l.free_space), sum_warp(l.sdf)};
}

// The first `count` sums of a block, its warps in order, and zeros up to `size`.
template <int kWarps>
__device__ __forceinline__ void store_sums(const WarpSums* sums, float* out, int count, int size) {
  const int i = threadIdx.x;
  if (i >= size) return;
  float sum = 0.0f;
  for (int w = 0; w < kWarps && i < count; ++w) sum += reinterpret_cast<const float*>(sums + w)[i];
  out[i] = sum;
}

template <Precision kPrecision, bool kTrain, int kWarps>
__device__ void run_rays(const RayStepArguments& a, BlockMemory<kPrecision, kTrain, kWarps>& memory) {
  const int lane = threadIdx.x % kWarp, warp = threadIdx.x / kWarp;
  build_image<kPrecision, kWarps * kWarp>(a.scene.geometry_params, a.scene.color_params, memory.image);
  __syncthreads();
  RayWarp<kPrecision, kTrain> ray(a, memory.image, memory.warps[warp], memory.stage(warp), lane);
  WeightGradients<kPrecision, kWarps> weights;
  RayLosses<float> losses{};
  WarpSums sums{};
  const std::int64_t stride = static_cast<std::int64_t>(gridDim.x) * kWarps;
  const std::int64_t rounds = (a.rays.num_rays + stride - 1) / stride;
  for (std::int64_t round = 0; round < rounds; ++round) {
    const std::int64_t r = round * stride + blockIdx.x * kWarps + warp;
    const bool exists = r < a.rays.num_rays;
    if (exists) {
      ray.forward(r, losses);
    } else {
      ray.skip();
    }
    if constexpr (kTrain) {
      // All warps of the block go back together, as each adds up a part of every warp's weight gradients.
      for (bool again = true; again;) {
        const int staged = ray.backward();
        if (lane == 0) memory.staged[warp] = staged;
        again = __syncthreads_or(ray.pending());
        weights.add(memory.stages, memory.staged, warp, lane);
        __syncthreads();
      }
    } else {
      while (ray.pending()) ray.backward();
    }
    if (a.pose && exists) {
      const PoseGradient gradient = ray.pose_gradient();
      for (int k = 0; k < kPoseGradientSize; ++k) {
        if (kTrain && lane == 0) a.pose_gradients[kPoseGradientStride * r + k] = gradient.values[k];
        if (!kTrain) sums.pose_gradient[k] += gradient.values[k];
      }
    }
  }
  sums.losses = sum_losses(losses);
  if (lane == 0) memory.sums[warp] = sums;
  __syncthreads();
  constexpr int kSize = kTrain ? kPartialSize : kTrackingPartialSize, kFirst = kTrain ? kPartialLosses : 0;
  float* partial = a.partials + static_cast<std::int64_t>(blockIdx.x) * kSize;
  if constexpr (kTrain) weights.store(partial, warp, lane);
  store_sums<kWarps>(memory.sums, partial + kFirst, kTrain ? kLossSums : kTrackingSums, kSize - kFirst);
}

template <Precision kPrecision, bool kTrain, int kWarps>
__global__ void __launch_bounds__(kWarps* kWarp, 1) ray_kernel(const __grid_constant__ RayStepArguments a) {
  extern __shared__ __align__(16) unsigned char shared[];
  if constexpr (has_variant<kPrecision, kTrain, kWarps>(kArchitecture)) {
    run_rays(a, *reinterpret_cast<BlockMemory<kPrecision, kTrain, kWarps>*>(shared));
  }
}

}  // namespace spslam::fused
