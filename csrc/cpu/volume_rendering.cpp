#include "launch/volume_rendering.h"

#include <algorithm>
#include <vector>

#include "core/parallel.h"

namespace spslam {
namespace {

constexpr std::int64_t kRayGrain = 32;
// Rays are padded to full vectors: a scalar remainder would take longer than all the rest.
constexpr std::int64_t kLanes = 16;

std::int64_t padded(std::int64_t count) {
  return (count + kLanes - 1) / kLanes * kLanes;
}

// One row of a table, copied into full vectors.
template <class T>
class PaddedRow {
 public:
  PaddedRow(std::int64_t count, std::int64_t width, T pad)
      : count_(count * width), values_(static_cast<std::size_t>(padded(count) * width), pad) {}

  T* load(const T* table, std::int64_t row) {
    std::copy_n(table + row * count_, count_, values_.data());
    return values_.data();
  }
  void store(T* table, std::int64_t row) const { std::copy_n(values_.data(), count_, table + row * count_); }
  T* data() { return values_.data(); }

 private:
  std::int64_t count_;
  std::vector<T> values_;
};

// The samples of one ray at a time. Padding is outside of the volume.
template <class T>
class PaddedSamples {
 public:
  PaddedSamples(const SampleTable<T>& table, T pad_t)
      : table_(table),
        sdf_(table.num_samples, 1, T(1)),
        t_(table.num_samples, 1, pad_t),
        valid_(table.num_samples, 1, false),
        mask_(table.num_samples, 1, T(0)) {}

  RaySamples<T, T> load(std::int64_t ray) {
    const std::uint8_t* valid = valid_.load(reinterpret_cast<const std::uint8_t*>(table_.valid), ray);
    const std::int64_t count = padded(table_.num_samples);
    T* mask = mask_.data();
    for (std::int64_t first = 0; first < count; first += kLanes) {
      for (std::int64_t lane = 0; lane < kLanes; ++lane) mask[first + lane] = static_cast<T>(valid[first + lane]);
    }
    return {sdf_.load(table_.sdf, ray), t_.load(table_.t, ray), mask, static_cast<std::int32_t>(count)};
  }

 private:
  const SampleTable<T>& table_;
  PaddedRow<T> sdf_, t_;
  PaddedRow<std::uint8_t> valid_;
  PaddedRow<T> mask_;
};

// Deeper than any surface: such a sample is neither near nor free. Its square may overflow, and is not used.
constexpr double kBehindEverything = 1e30;

template <class T>
void render_without_color(const SampleTable<T>& table, T truncation, T* out_depth, T* weights) {
  parallel_for(table.num_rays, kRayGrain, [&](std::int64_t begin, std::int64_t end) {
    PaddedSamples<T> samples(table, T(0));
    PaddedRow<T> ray_weights(table.num_samples, 1, T(0));
    for (std::int64_t r = begin; r < end; ++r) {
      T* const no_color = nullptr;
      render_ray<false>(samples.load(r), no_color, truncation, no_color, out_depth + r, ray_weights.data());
      ray_weights.store(weights, r);
    }
  });
}

template <class T>
void render_without_color_backward(const SampleTable<T>& table, const T* weights, T truncation, const T* grad_out_depth,
                                   const T* grad_weights, T* grad_sdf, T* grad_t) {
  const std::int64_t count = table.num_samples;
  parallel_for(table.num_rays, kRayGrain, [&](std::int64_t begin, std::int64_t end) {
    PaddedSamples<T> samples(table, T(0));
    PaddedRow<T> ray_weights(count, 1, T(0)), ray_grad_weights(count, 1, T(0));
    PaddedRow<T> ray_grad_sdf(count, 1, T(0)), ray_grad_t(count, 1, T(0));
    for (std::int64_t r = begin; r < end; ++r) {
      const RenderGradient<T> grad{nullptr, grad_out_depth[r],
                                   grad_weights ? ray_grad_weights.load(grad_weights, r) : ray_grad_weights.data()};
      T* const no_color = nullptr;
      render_ray_backward<false>(samples.load(r), no_color, ray_weights.load(weights, r), truncation, grad,
                                 ray_grad_sdf.data(), no_color, ray_grad_t.data());
      ray_grad_sdf.store(grad_sdf, r);
      ray_grad_t.store(grad_t, r);
    }
  });
}

}  // namespace

template <class Device, class T>
void volume_render(Device, const SampleTable<T>& table, const T* color, T truncation, T* out_color, T* out_depth,
                   T* weights) {
  if (!out_color) return render_without_color(table, truncation, out_depth, weights);
  parallel_for(table.num_rays, kRayGrain, [&](std::int64_t begin, std::int64_t end) {
    PaddedSamples<T> samples(table, T(0));
    PaddedRow<T> ray_color(table.num_samples, 3, T(0)), ray_weights(table.num_samples, 1, T(0));
    for (std::int64_t r = begin; r < end; ++r) {
      render_ray(samples.load(r), ray_color.load(color, r), truncation, out_color + 3 * r, out_depth + r,
                 ray_weights.data());
      ray_weights.store(weights, r);
    }
  });
}

template <class Device, class T>
void volume_render_backward(Device, const SampleTable<T>& table, const T* color, const T* weights, T truncation,
                            const T* grad_out_color, const T* grad_out_depth, const T* grad_weights, T* grad_sdf,
                            T* grad_color, T* grad_t) {
  if (!grad_out_color) {
    return render_without_color_backward(table, weights, truncation, grad_out_depth, grad_weights, grad_sdf, grad_t);
  }
  const std::int64_t count = table.num_samples;
  parallel_for(table.num_rays, kRayGrain, [&](std::int64_t begin, std::int64_t end) {
    PaddedSamples<T> samples(table, T(0));
    PaddedRow<T> ray_color(count, 3, T(0)), ray_weights(count, 1, T(0)), ray_grad_weights(count, 1, T(0));
    PaddedRow<T> ray_grad_sdf(count, 1, T(0)), ray_grad_color(count, 3, T(0)), ray_grad_t(count, 1, T(0));
    for (std::int64_t r = begin; r < end; ++r) {
      const RenderGradient<T> grad{grad_out_color + 3 * r, grad_out_depth[r],
                                   grad_weights ? ray_grad_weights.load(grad_weights, r) : ray_grad_weights.data()};
      render_ray_backward(samples.load(r), ray_color.load(color, r), ray_weights.load(weights, r), truncation, grad,
                          ray_grad_sdf.data(), ray_grad_color.data(), ray_grad_t.data());
      ray_grad_sdf.store(grad_sdf, r);
      ray_grad_color.store(grad_color, r);
      ray_grad_t.store(grad_t, r);
    }
  });
}

template <class Device, class T>
void rendering_losses(Device, const SampleTable<T>& table, const LossInputs<T>& inputs, T* losses, T* workspace) {
  parallel_for(table.num_rays, kRayGrain, [&](std::int64_t begin, std::int64_t end) {
    PaddedSamples<T> samples(table, T(kBehindEverything));
    for (std::int64_t r = begin; r < end; ++r) {
      ray_losses(samples.load(r), inputs.color + 3 * r, inputs.depth[r], ray_target(inputs, r), inputs.truncation,
                 workspace + 4 * r);
    }
  });
  for (int k = 0; k < 4; ++k) {
    double sum = 0;
    for (std::int64_t r = 0; r < table.num_rays; ++r) sum += workspace[4 * r + k];
    losses[k] = table.num_rays > 0 ? static_cast<T>(sum / static_cast<double>(table.num_rays)) : T(0);
  }
}

template <class Device, class T>
void rendering_losses_backward(Device, const SampleTable<T>& table, const LossInputs<T>& inputs, const T* grad_losses,
                               T* grad_color, T* grad_depth, T* grad_sdf, T* grad_t) {
  const std::int64_t count = table.num_samples;
  T grad[4];
  for (int k = 0; k < 4; ++k) grad[k] = grad_losses[k] / static_cast<T>(std::max<std::int64_t>(table.num_rays, 1));
  parallel_for(table.num_rays, kRayGrain, [&](std::int64_t begin, std::int64_t end) {
    PaddedSamples<T> samples(table, T(kBehindEverything));
    PaddedRow<T> ray_grad_sdf(count, 1, T(0)), ray_grad_t(count, 1, T(0));
    for (std::int64_t r = begin; r < end; ++r) {
      ray_losses_backward(samples.load(r), inputs.color + 3 * r, inputs.depth[r], ray_target(inputs, r),
                          inputs.truncation, grad, grad_color + 3 * r, grad_depth + r, ray_grad_sdf.data(),
                          ray_grad_t.data());
      ray_grad_sdf.store(grad_sdf, r);
      ray_grad_t.store(grad_t, r);
    }
  });
}

SPS_INSTANTIATE_VOLUME_RENDERING(Cpu, float)
SPS_INSTANTIATE_VOLUME_RENDERING(Cpu, double)
}  // namespace spslam
