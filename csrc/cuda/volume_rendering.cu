#include "core/for_each.h"
#include "launch/volume_rendering.h"

namespace spslam {

template <class T>
__device__ RaySamples<T, bool> ray_samples(const SampleTable<T>& samples, std::int64_t r) {
  const std::int64_t first = r * samples.num_samples;
  return {samples.sdf + first, samples.t + first, samples.valid + first,
          static_cast<std::int32_t>(samples.num_samples)};
}

// One ray per thread. Device lambdas hold copies, never references.

template <class Device, class T>
void volume_render(Device device, const SampleTable<T>& table, const T* color, T truncation, T* out_color, T* out_depth,
                   T* weights) {
  const SampleTable<T> samples = table;
  if (!out_color) {
    return for_each(device, samples.num_rays, [=] __device__(std::int64_t r) {
      T* const no_color = nullptr;
      render_ray<false>(ray_samples(samples, r), no_color, truncation, no_color, out_depth + r,
                        weights + r * samples.num_samples);
    });
  }
  for_each(device, samples.num_rays, [=] __device__(std::int64_t r) {
    const std::int64_t first = r * samples.num_samples;
    render_ray(ray_samples(samples, r), color + 3 * first, truncation, out_color + 3 * r, out_depth + r,
               weights + first);
  });
}

template <class Device, class T>
void volume_render_backward(Device device, const SampleTable<T>& table, const T* color, const T* weights, T truncation,
                            const T* grad_out_color, const T* grad_out_depth, const T* grad_weights, T* grad_sdf,
                            T* grad_color, T* grad_t) {
  const SampleTable<T> samples = table;
  if (!grad_out_color) {
    return for_each(device, samples.num_rays, [=] __device__(std::int64_t r) {
      const std::int64_t first = r * samples.num_samples;
      T* const no_color = nullptr;
      const RenderGradient<T> grad{no_color, grad_out_depth[r], grad_weights ? grad_weights + first : nullptr};
      render_ray_backward<false>(ray_samples(samples, r), no_color, weights + first, truncation, grad, grad_sdf + first,
                                 no_color, grad_t + first);
    });
  }
  for_each(device, samples.num_rays, [=] __device__(std::int64_t r) {
    const std::int64_t first = r * samples.num_samples;
    const RenderGradient<T> grad{grad_out_color + 3 * r, grad_out_depth[r],
                                 grad_weights ? grad_weights + first : nullptr};
    render_ray_backward(ray_samples(samples, r), color + 3 * first, weights + first, truncation, grad, grad_sdf + first,
                        grad_color + 3 * first, grad_t + first);
  });
}

template <class Device, class T>
void rendering_losses(Device device, const SampleTable<T>& table, const LossInputs<T>& all_inputs, T* losses,
                      T* workspace) {
  const SampleTable<T> samples = table;
  const LossInputs<T> inputs = all_inputs;
  T* const terms = workspace;
  T* const partials = workspace + 4 * samples.num_rays;
  for_each(device, samples.num_rays, [=] __device__(std::int64_t r) {
    ray_losses(ray_samples(samples, r), inputs.color + 3 * r, inputs.depth[r], ray_target(inputs, r), inputs.truncation,
               terms + 4 * r);
  });
  for_each(device, 4 * kLossPartials, [=] __device__(std::int64_t i) {
    T sum = 0;
    for (std::int64_t r = i / 4; r < samples.num_rays; r += kLossPartials) sum += terms[4 * r + i % 4];
    partials[i] = sum;
  });
  for_each(device, 4, [=] __device__(std::int64_t k) {
    T sum = 0;
    for (std::int64_t p = 0; p < kLossPartials; ++p) sum += partials[4 * p + k];
    losses[k] = samples.num_rays > 0 ? sum / static_cast<T>(samples.num_rays) : T(0);
  });
}

template <class Device, class T>
void rendering_losses_backward(Device device, const SampleTable<T>& table, const LossInputs<T>& all_inputs,
                               const T* grad_losses, T* grad_color, T* grad_depth, T* grad_sdf, T* grad_t) {
  const SampleTable<T> samples = table;
  const LossInputs<T> inputs = all_inputs;
  for_each(device, samples.num_rays, [=] __device__(std::int64_t r) {
    const std::int64_t first = r * samples.num_samples;
    const T share = 1 / static_cast<T>(samples.num_rays);
    const T grad[4] = {share * grad_losses[0], share * grad_losses[1], share * grad_losses[2], share * grad_losses[3]};
    ray_losses_backward(ray_samples(samples, r), inputs.color + 3 * r, inputs.depth[r], ray_target(inputs, r),
                        inputs.truncation, grad, grad_color + 3 * r, grad_depth + r, grad_sdf + first, grad_t + first);
  });
}

SPS_INSTANTIATE_VOLUME_RENDERING(Cuda, float)
SPS_INSTANTIATE_VOLUME_RENDERING(Cuda, double)
}  // namespace spslam
