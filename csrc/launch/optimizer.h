// What the optimizer's launches share between the devices.
#pragma once

#include <cmath>
#include <limits>

#include "core/for_each.h"
#include "kernels/optimizer.h"
#include "spslam/optimizer.h"

namespace spslam {

template <class T>
AdamCoefficients<T> adam_coefficients(const AdamStep& s) {
  const double step = static_cast<double>(s.step);
  return {static_cast<T>(1.0 - s.beta1),
          static_cast<T>(s.beta2),
          static_cast<T>(1.0 - s.beta2),
          static_cast<T>(s.learning_rate / (1.0 - std::pow(s.beta1, step))),
          static_cast<T>(1.0 / std::sqrt(1.0 - std::pow(s.beta2, step))),
          static_cast<T>(s.epsilon)};
}

// Adds the partial sums of each frame, in order.
template <class Device, class T>
void reduce_normal_equations(Device device, std::int64_t frames, std::int64_t chunks, const double* partials,
                             T* hessian, T* gradient, T* cost) {
  for_each(
      device, frames,
      [=] SPS_HOST_DEVICE(std::int64_t frame) {
        double terms[kNormalTerms] = {};
        for (std::int64_t chunk = frame * chunks; chunk < (frame + 1) * chunks; ++chunk) {
          for (int t = 0; t < kNormalTerms; ++t) terms[t] += partials[chunk * kNormalTerms + t];
        }
        store_normal_terms(terms, hessian + frame * 36, gradient + frame * 6, cost + frame);
      },
      16);
}

template <class Device, class T>
void solve_normal_equations(Device device, std::int64_t frames, const T* hessian, const T* gradient, double damping,
                            double absolute_damping, T* delta) {
  const double tolerance = 8.0 * static_cast<double>(std::numeric_limits<T>::epsilon());
  for_each(
      device, frames,
      [=] SPS_HOST_DEVICE(std::int64_t frame) {
        solve_damped_6x6(hessian + frame * 36, gradient + frame * 6, damping, absolute_damping, tolerance,
                         delta + frame * 6);
      },
      64);
}

#define SPS_INSTANTIATE_OPTIMIZER(Device, T)                                                                           \
  template void sparse_adam<Device, T>(Device, const AdamStep&, std::int64_t, std::int64_t, const std::int32_t*,       \
                                       std::int32_t, T*, T*, T*, T*);                                                  \
  template void normal_equations<Device, T>(Device, std::int64_t, std::int64_t, const T*, const T*, const T*, double*, \
                                            T*, T*, T*);                                                               \
  template void solve_normal_equations<Device, T>(Device, std::int64_t, const T*, const T*, double, double, T*);

}  // namespace spslam
