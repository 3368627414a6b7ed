// One warp per ray: its lanes are 32 samples of the ray at a time for products along it, and groups of channels for
// sums over it. All sums have a fixed order.
#include <cuda_runtime.h>

#include <limits>

#include "core/cuda_check.cuh"
#include "kernels/alpha_composite.h"

namespace spslam {
namespace {

constexpr int kWarp = 32, kBlockWarps = 8, kMaxBlocks = 65535;
constexpr unsigned kAllLanes = 0xffffffffu;

template <class T>
__device__ SampleOpacity<T> load_opacity(const CompositeInputs<T>& in, std::int64_t n) {
  return in.lengths ? sample_opacity(in.opacities[n], in.lengths[n]) : sample_opacity(in.opacities[n]);
}

template <class T>
__device__ T warp_sum(T value) {
  for (int offset = kWarp / 2; offset; offset /= 2) value += __shfl_xor_sync(kAllLanes, value, offset);
  return value;
}

// Walks along a ray and calls f(n, opacity, transmittance) for each sample that takes part; returns their number.
template <class T, class F>
__device__ std::int64_t walk_ray(const CompositeInputs<T>& in, const RaySpan& span, const F& f) {
  const int lane = threadIdx.x % kWarp;
  T reaching = 1;
  for (std::int64_t first = 0; first < span.count; first += kWarp) {
    const std::int64_t i = first + lane;
    const bool inside = i < span.count;
    const SampleOpacity<T> opacity = inside ? load_opacity(in, span.first + i) : SampleOpacity<T>{T(0), T(1)};
    T product = opacity.pass;
#pragma unroll
    for (int offset = 1; offset < kWarp; offset *= 2) {
      const T before = __shfl_up_sync(kAllLanes, product, offset);
      if (lane >= offset) product *= before;
    }
    const T before = __shfl_up_sync(kAllLanes, product, 1);
    const T transmittance = reaching * (lane > 0 ? before : T(1));
    const unsigned stopped = __ballot_sync(kAllLanes, inside && !takes_part(transmittance, in.stop));
    const int last = stopped ? __ffs(stopped) - 1 : kWarp;  // the samples behind it take no part either
    if (inside && lane < last) f(span.first + i, opacity, transmittance);
    if (stopped) return first + last;
    reaching *= __shfl_sync(kAllLanes, product, kWarp - 1);
  }
  return span.count;
}

// Lanes that share a sample's channels: the power of two that holds them, or a warp.
__device__ inline int channel_lanes(std::int64_t channels) {
  int lanes = 1;
  while (lanes < channels && lanes < kWarp) lanes *= 2;
  return lanes;
}

template <class T>
__device__ void sum_values(const CompositeInputs<T>& in, const RaySpan& span, std::int64_t end, const T* weights,
                           T* out) {
  const int lane = threadIdx.x % kWarp, width = channel_lanes(in.channels);
  for (std::int64_t first = 0; first < in.channels; first += width) {
    const std::int64_t c = first + lane % width;
    T sum = 0;
    if (c < in.channels) {
      for (std::int64_t i = lane / width; i < end; i += kWarp / width) {
        const std::int64_t n = span.first + i;
        sum += weights[n] * in.values[n * in.channels + c];
      }
    }
    for (int offset = width; offset < kWarp; offset *= 2) sum += __shfl_xor_sync(kAllLanes, sum, offset);
    if (lane < width && c < in.channels) out[c] = span.valid ? sum : std::numeric_limits<T>::quiet_NaN();
  }
}

template <class T>
__global__ void __launch_bounds__(kBlockWarps* kWarp)
    composite_kernel(const __grid_constant__ CompositeInputs<T> in, const __grid_constant__ CompositeOutputs<T> out) {
  const int lane = threadIdx.x % kWarp;
  const std::int64_t stride = static_cast<std::int64_t>(gridDim.x) * kBlockWarps;
  for (std::int64_t r = static_cast<std::int64_t>(blockIdx.x) * kBlockWarps + threadIdx.x / kWarp;
       r < in.spans.num_rays; r += stride) {
    const RaySpan span = ray_span(in.spans, r);
    T depth = 0, opacity = 0;
    const std::int64_t end = walk_ray(in, span, [&](std::int64_t n, const SampleOpacity<T>& sample, T transmittance) {
      const T weight = transmittance * sample.alpha;
      out.weights[n] = weight;
      depth += weight * in.t[n];
      opacity += weight;
    });
    for (std::int64_t i = end + lane; i < span.count; i += kWarp) out.weights[span.first + i] = T(0);
    depth = warp_sum(depth);
    opacity = warp_sum(opacity);
    if (lane == 0) {
      out.depth[r] = span.valid ? depth : std::numeric_limits<T>::quiet_NaN();
      out.opacity[r] = span.valid ? opacity : std::numeric_limits<T>::quiet_NaN();
    }
    __syncwarp();  // the weights are visible to all lanes
    sum_values(in, span, end, out.weights, out.values + r * in.channels);
  }
}

// Gradients of the values, and into `of_weights` those by the weights.
template <class T>
__device__ void value_gradients(const CompositeInputs<T>& in, const RaySpan& span, std::int64_t end, const T* weights,
                                const CompositeOutputGradients<T>& grad, std::int64_t r, T* grad_values,
                                T* of_weights) {
  const int lane = threadIdx.x % kWarp, width = channel_lanes(in.channels);
  const T* const g = grad.values + r * in.channels;
  for (std::int64_t first = 0; first < end; first += kWarp / width) {  // all lanes take all turns, for the sum
    const std::int64_t i = first + lane / width, n = span.first + i;
    T sum = 0;
    if (i < end) {
      for (std::int64_t c = lane % width; c < in.channels; c += width) {
        sum += g[c] * in.values[n * in.channels + c];
        grad_values[n * in.channels + c] = weights[n] * g[c];
      }
    }
    for (int offset = width / 2; offset; offset /= 2) sum += __shfl_xor_sync(kAllLanes, sum, offset);
    if (i < end && lane % width == 0) {
      of_weights[n] = sum + grad.depth[r] * in.t[n] + grad.opacity[r] + (grad.weights ? grad.weights[n] : T(0));
    }
  }
}

// What lies behind a sample, as a function of what lies behind the samples in view: add + scale x.
template <class T>
struct Behind {
  T add, scale;
};

template <class T>
__global__ void __launch_bounds__(kBlockWarps* kWarp)
    composite_backward_kernel(const __grid_constant__ CompositeInputs<T> in, const T* weights,
                              const __grid_constant__ CompositeOutputGradients<T> grad,
                              const __grid_constant__ CompositeInputGradients<T> out) {
  const int lane = threadIdx.x % kWarp;
  const std::int64_t stride = static_cast<std::int64_t>(gridDim.x) * kBlockWarps;
  for (std::int64_t r = static_cast<std::int64_t>(blockIdx.x) * kBlockWarps + threadIdx.x / kWarp;
       r < in.spans.num_rays; r += stride) {
    const RaySpan span = ray_span(in.spans, r);
    // Outputs hold what a later step needs: that by t the transmittances, that by the opacities those by the weights.
    const std::int64_t end =
        walk_ray(in, span, [&](std::int64_t n, const SampleOpacity<T>&, T transmittance) { out.t[n] = transmittance; });
    for (std::int64_t i = end + lane; i < span.count; i += kWarp) {
      out.opacities[span.first + i] = out.t[span.first + i] = T(0);
      if (out.lengths) out.lengths[span.first + i] = T(0);
    }
    for (std::int64_t i = (span.first + end) * in.channels + lane; i < (span.first + span.count) * in.channels;
         i += kWarp) {
      out.values[i] = T(0);
    }
    value_gradients(in, span, end, weights, grad, r, out.values, out.opacities);
    __syncwarp();

    T passed = 0;
    for (std::int64_t first = end > 0 ? (end - 1) / kWarp * kWarp : -1; first >= 0; first -= kWarp) {
      const std::int64_t i = first + lane, n = span.first + i;
      const bool inside = i < end;
      const SampleOpacity<T> opacity = inside ? load_opacity(in, n) : SampleOpacity<T>{T(0), T(1)};
      const T of_weight = inside ? out.opacities[n] : T(0), transmittance = inside ? out.t[n] : T(0);
      Behind<T> behind{opacity.alpha * of_weight, opacity.pass};
#pragma unroll
      for (int offset = 1; offset < kWarp; offset *= 2) {
        const T add = __shfl_down_sync(kAllLanes, behind.add, offset);
        const T scale = __shfl_down_sync(kAllLanes, behind.scale, offset);
        if (lane + offset < kWarp) behind = {behind.add + behind.scale * add, behind.scale * scale};
      }
      const T add = __shfl_down_sync(kAllLanes, behind.add, 1), scale = __shfl_down_sync(kAllLanes, behind.scale, 1);
      const T of_passed = lane + 1 < kWarp ? add + scale * passed : passed;
      passed = __shfl_sync(kAllLanes, behind.add, 0) + __shfl_sync(kAllLanes, behind.scale, 0) * passed;
      if (!inside) continue;
      const T of_alpha = alpha_gradient(transmittance, of_weight, of_passed);
      out.t[n] = weights[n] * grad.depth[r];
      if (out.lengths) {
        const T of_depth = optical_depth_gradient(of_alpha, opacity.pass);
        out.opacities[n] = of_depth * in.lengths[n];
        out.lengths[n] = of_depth * in.opacities[n];
      } else {
        out.opacities[n] = of_alpha;
      }
    }
  }
}

int num_blocks(std::int64_t rays) {
  const std::int64_t blocks = (rays + kBlockWarps - 1) / kBlockWarps;
  return static_cast<int>(blocks < kMaxBlocks ? blocks : kMaxBlocks);
}

}  // namespace

template <class Device, class T>
void alpha_composite(Device device, const CompositeInputs<T>& inputs, const CompositeOutputs<T>& out) {
  if (inputs.spans.num_rays == 0) return;
  composite_kernel<T>
      <<<num_blocks(inputs.spans.num_rays), kBlockWarps * kWarp, 0, static_cast<cudaStream_t>(device.stream)>>>(inputs,
                                                                                                                out);
}

template <class Device, class T>
void alpha_composite_backward(Device device, const CompositeInputs<T>& inputs, const T* weights,
                              const CompositeOutputGradients<T>& grad, const CompositeInputGradients<T>& out) {
  if (inputs.spans.num_rays == 0) return;
  composite_backward_kernel<T>
      <<<num_blocks(inputs.spans.num_rays), kBlockWarps * kWarp, 0, static_cast<cudaStream_t>(device.stream)>>>(
          inputs, weights, grad, out);
}

#define SPS_INSTANTIATE_ALPHA_COMPOSITE(T)                                                             \
  template void alpha_composite<Cuda, T>(Cuda, const CompositeInputs<T>&, const CompositeOutputs<T>&); \
  template void alpha_composite_backward<Cuda, T>(Cuda, const CompositeInputs<T>&, const T*,           \
                                                  const CompositeOutputGradients<T>&,                  \
                                                  const CompositeInputGradients<T>&);
SPS_INSTANTIATE_ALPHA_COMPOSITE(float)
SPS_INSTANTIATE_ALPHA_COMPOSITE(double)

}  // namespace spslam
