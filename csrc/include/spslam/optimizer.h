// Sparse Adam steps and the normal equations of Gauss-Newton pose steps.
#pragma once

#include <cstdint>

#include "core/device.h"

namespace spslam {

struct AdamStep {
  double learning_rate, beta1, beta2, epsilon;
  std::int64_t step;  // 1-based, for the bias correction
};

// One Adam step in place on the rows r of [rows, channels] with stamps[r] == stamp (every row where stamps is null).
// The gradients of these rows are set to zero; other rows are left as they are.
template <class Device, class T>
void sparse_adam(Device device, const AdamStep& step, std::int64_t rows, std::int64_t channels,
                 const std::int32_t* stamps, std::int32_t stamp, T* param, T* grad, T* exp_avg, T* exp_avg_sq);

// Upper triangle of the hessian (21, row by row), gradient (6) and cost (1) of one partial sum.
constexpr int kNormalTerms = 28;
// Residuals in one partial sum.
constexpr std::int64_t kNormalChunk = 256;

inline std::int64_t normal_equations_partials(std::int64_t frames, std::int64_t residuals) {
  return frames * ((residuals + kNormalChunk - 1) / kNormalChunk) * kNormalTerms;
}

// hessian [F, 6, 6] = sum w J^T J, gradient [F, 6] = sum w r J, cost [F] = sum w r^2 over `count` residuals per frame.
// `partials` is scratch of normal_equations_partials(frames, count) doubles. The order of the sums is fixed.
template <class Device, class T>
void normal_equations(Device device, std::int64_t frames, std::int64_t count, const T* residuals, const T* jacobians,
                      const T* weights, double* partials, T* hessian, T* gradient, T* cost);

// delta [F, 6] = -(H + damping diag(H) + absolute_damping I)^-1 g by LDL^T in double precision; 0 where that matrix is
// not positive definite or something is not finite.
template <class Device, class T>
void solve_normal_equations(Device device, std::int64_t frames, const T* hessian, const T* gradient, double damping,
                            double absolute_damping, T* delta);

}  // namespace spslam
