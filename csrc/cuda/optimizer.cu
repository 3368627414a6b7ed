#include "launch/optimizer.h"

namespace spslam {
namespace {

constexpr int kWarp = 32;
constexpr int kWarps = static_cast<int>(kNormalChunk) / kWarp;

// One block per chunk, one thread per residual; summed by shuffles within a warp, then over the warps in order.
template <class T>
__global__ void accumulate_chunks(std::int64_t count, std::int64_t chunks, const T* residuals, const T* jacobians,
                                  const T* weights, double* partials) {
  __shared__ double sums[kWarps][kNormalTerms];
  const std::int64_t frame = blockIdx.x / chunks;
  const std::int64_t i = (blockIdx.x % chunks) * kNormalChunk + threadIdx.x;
  T terms[kNormalTerms] = {};
  const std::int64_t at = frame * count + i;
  // A residual of weight 0 is left out rather than multiplied by it, because it may not be finite.
  if (i < count && weights[at] != T(0)) {
    add_normal_terms(jacobians + at * 6, residuals[at], weights[at], terms);
  }
  for (int t = 0; t < kNormalTerms; ++t) {
    double sum = static_cast<double>(terms[t]);
    for (int offset = kWarp / 2; offset > 0; offset /= 2) sum += __shfl_down_sync(0xffffffffu, sum, offset);
    if (threadIdx.x % kWarp == 0) sums[threadIdx.x / kWarp][t] = sum;
  }
  __syncthreads();
  if (threadIdx.x < kNormalTerms) {
    double sum = 0.0;
    for (int warp = 0; warp < kWarps; ++warp) sum += sums[warp][threadIdx.x];
    partials[static_cast<std::int64_t>(blockIdx.x) * kNormalTerms + threadIdx.x] = sum;
  }
}

}  // namespace

template <class Device, class T>
void sparse_adam(Device device, const AdamStep& step, std::int64_t rows, std::int64_t channels,
                 const std::int32_t* stamps, std::int32_t stamp, T* param, T* grad, T* exp_avg, T* exp_avg_sq) {
  const AdamCoefficients<T> c = adam_coefficients<T>(step);
  for_each(device, rows * channels, [=] SPS_HOST_DEVICE(std::int64_t i) {
    if (stamps != nullptr && stamps[i / channels] != stamp) return;
    adam_update(c, param[i], grad[i], exp_avg[i], exp_avg_sq[i]);
  });
}

template <class Device, class T>
void normal_equations(Device device, std::int64_t frames, std::int64_t count, const T* residuals, const T* jacobians,
                      const T* weights, double* partials, T* hessian, T* gradient, T* cost) {
  const std::int64_t chunks = chunk_count(count, kNormalChunk);
  if (frames * chunks > 0) {
    accumulate_chunks<<<static_cast<unsigned>(frames * chunks), kNormalChunk, 0,
                        static_cast<cudaStream_t>(device.stream)>>>(count, chunks, residuals, jacobians, weights,
                                                                    partials);
  }
  reduce_normal_equations(device, frames, chunks, partials, hessian, gradient, cost);
}

SPS_INSTANTIATE_OPTIMIZER(Cuda, float)
SPS_INSTANTIATE_OPTIMIZER(Cuda, double)
}  // namespace spslam
