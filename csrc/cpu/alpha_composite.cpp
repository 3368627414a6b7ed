#include "kernels/alpha_composite.h"

#include <algorithm>
#include <limits>
#include <vector>

#include "core/parallel.h"
#include "cpu/channels.h"

namespace spslam {
namespace {

constexpr std::int64_t kRayGrain = 32;

// Opacities and transmittances of one ray at a time.
template <class T>
class RayOpacities {
 public:
  explicit RayOpacities(const CompositeInputs<T>& in) : in_(in) {}

  // Returns the number of samples that take part.
  std::int64_t load(const RaySpan& span) {
    const auto count = static_cast<std::size_t>(span.count);
    for (std::vector<T>* row : {&alpha, &pass, &transmittance}) {
      if (row->size() < count) row->resize(count);
    }
    const T* x = in_.opacities + span.first;
    T *const a = alpha.data(), *const p = pass.data();
    if (in_.lengths) {
      const T* lengths = in_.lengths + span.first;
      SPS_SIMD
      for (std::int64_t i = 0; i < span.count; ++i) {
        const SampleOpacity<T> opacity = sample_opacity(x[i], lengths[i]);
        a[i] = opacity.alpha;
        p[i] = opacity.pass;
      }
    } else {
      SPS_SIMD
      for (std::int64_t i = 0; i < span.count; ++i) {
        const SampleOpacity<T> opacity = sample_opacity(x[i]);
        a[i] = opacity.alpha;
        p[i] = opacity.pass;
      }
    }
    T reaching = 1;
    for (std::int64_t i = 0; i < span.count; ++i) {
      if (!takes_part(reaching, in_.stop)) return i;
      transmittance[static_cast<std::size_t>(i)] = reaching;
      reaching *= p[i];
    }
    return span.count;
  }

  std::vector<T> alpha, pass, transmittance;

 private:
  const CompositeInputs<T>& in_;
};

template <int kChannels, class T>
void composite_ray(const CompositeInputs<T>& in, const CompositeOutputs<T>& out, std::int64_t r,
                   RayOpacities<T>& opacities) {
  const std::int64_t channels = kChannels ? kChannels : in.channels;
  const RaySpan span = ray_span(in.spans, r);
  const std::int64_t end = opacities.load(span);
  const T *values = in.values + span.first * channels, *t = in.t + span.first;
  T* const weights = out.weights + span.first;
  T* const sums = out.values + r * channels;
  const T nothing = span.valid ? T(0) : std::numeric_limits<T>::quiet_NaN();
  T depth = nothing, opacity = nothing;
  std::fill_n(sums, channels, nothing);
  for (std::int64_t i = 0; i < end; ++i) {
    const auto at = static_cast<std::size_t>(i);
    const T weight = opacities.transmittance[at] * opacities.alpha[at];
    weights[i] = weight;
    depth += weight * t[i];
    opacity += weight;
    SPS_SIMD
    for (std::int64_t c = 0; c < channels; ++c) sums[c] += weight * values[i * channels + c];
  }
  std::fill(weights + end, weights + span.count, T(0));
  out.depth[r] = depth;
  out.opacity[r] = opacity;
}

template <int kChannels, class T>
void composite_ray_backward(const CompositeInputs<T>& in, const T* all_weights, const CompositeOutputGradients<T>& grad,
                            const CompositeInputGradients<T>& out, std::int64_t r, RayOpacities<T>& opacities) {
  const std::int64_t channels = kChannels ? kChannels : in.channels;
  const RaySpan span = ray_span(in.spans, r);
  const std::int64_t end = opacities.load(span);
  const T* const g = grad.values + r * channels;
  T passed = 0;
  for (std::int64_t i = span.count - 1; i >= 0; --i) {
    const std::int64_t n = span.first + i;
    T* const grad_values = out.values + n * channels;
    if (i >= end) {
      out.opacities[n] = out.t[n] = 0;
      if (out.lengths) out.lengths[n] = 0;
      std::fill_n(grad_values, channels, T(0));
      continue;
    }
    const auto at = static_cast<std::size_t>(i);
    const T weight = all_weights[n], alpha = opacities.alpha[at], pass = opacities.pass[at];
    T of_weight = grad.depth[r] * in.t[n] + grad.opacity[r] + (grad.weights ? grad.weights[n] : T(0));
    const T* const value = in.values + n * channels;
    SPS_SIMD_SUM(of_weight)
    for (std::int64_t c = 0; c < channels; ++c) of_weight += g[c] * value[c];
    SPS_SIMD
    for (std::int64_t c = 0; c < channels; ++c) grad_values[c] = weight * g[c];
    out.t[n] = weight * grad.depth[r];
    const T of_alpha = alpha_gradient(opacities.transmittance[at], of_weight, passed);
    passed = alpha * of_weight + pass * passed;
    if (out.lengths) {
      const T of_depth = optical_depth_gradient(of_alpha, pass);
      out.opacities[n] = of_depth * in.lengths[n];
      out.lengths[n] = of_depth * in.opacities[n];
    } else {
      out.opacities[n] = of_alpha;
    }
  }
}

}  // namespace

template <class Device, class T>
void alpha_composite(Device, const CompositeInputs<T>& inputs, const CompositeOutputs<T>& out) {
  with_channels<1, 3, 4, 16, 32>(inputs.channels, [&](auto constant) {
    parallel_for(inputs.spans.num_rays, kRayGrain, [&](std::int64_t begin, std::int64_t end) {
      RayOpacities<T> opacities(inputs);
      for (std::int64_t r = begin; r < end; ++r) {
        composite_ray<decltype(constant)::value>(inputs, out, r, opacities);
      }
    });
  });
}

template <class Device, class T>
void alpha_composite_backward(Device, const CompositeInputs<T>& inputs, const T* weights,
                              const CompositeOutputGradients<T>& grad, const CompositeInputGradients<T>& out) {
  with_channels<1, 3, 4, 16, 32>(inputs.channels, [&](auto constant) {
    parallel_for(inputs.spans.num_rays, kRayGrain, [&](std::int64_t begin, std::int64_t end) {
      RayOpacities<T> opacities(inputs);
      for (std::int64_t r = begin; r < end; ++r) {
        composite_ray_backward<decltype(constant)::value>(inputs, weights, grad, out, r, opacities);
      }
    });
  });
}

#define SPS_INSTANTIATE_ALPHA_COMPOSITE(T)                                                           \
  template void alpha_composite<Cpu, T>(Cpu, const CompositeInputs<T>&, const CompositeOutputs<T>&); \
  template void alpha_composite_backward<Cpu, T>(Cpu, const CompositeInputs<T>&, const T*,           \
                                                 const CompositeOutputGradients<T>&,                 \
                                                 const CompositeInputGradients<T>&);
SPS_INSTANTIATE_ALPHA_COMPOSITE(float)
SPS_INSTANTIATE_ALPHA_COMPOSITE(double)

}  // namespace spslam
