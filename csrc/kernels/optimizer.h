// The maths of one parameter, one residual and one 6x6 system.
#pragma once

#include <cmath>

#include "core/macros.h"
#include "spslam/optimizer.h"

namespace spslam {

// Adam's published decay rates and floor.
constexpr double kAdamBeta1 = 0.9, kAdamBeta2 = 0.999, kAdamEpsilon = 1e-8;

// Adam's constants for one step, as torch.optim.Adam forms them.
template <class T>
struct AdamCoefficients {
  T one_minus_beta1, beta2, one_minus_beta2, step_size, inverse_sqrt_correction, epsilon;
};

template <class T>
SPS_INLINE void adam_update(const AdamCoefficients<T>& c, T& param, T& grad, T& exp_avg, T& exp_avg_sq) {
  const T g = grad;
  const T m = exp_avg + c.one_minus_beta1 * (g - exp_avg);
  const T v = c.beta2 * exp_avg_sq + c.one_minus_beta2 * g * g;
  exp_avg = m;
  exp_avg_sq = v;
  param -= c.step_size * m / (std::sqrt(v) * c.inverse_sqrt_correction + c.epsilon);
  grad = T(0);
}

// Adds one residual's share to the kNormalTerms terms. `V` is a number, or a vector register of them.
template <class V>
SPS_INLINE void add_normal_terms(const V* jacobian, const V& residual, const V& weight, V* terms) {
  int term = 0;
  SPS_UNROLL
  for (int a = 0; a < 6; ++a) {
    const V wj = weight * jacobian[a];
    SPS_UNROLL
    for (int b = a; b < 6; ++b) terms[term++] += wj * jacobian[b];
  }
  const V wr = weight * residual;
  SPS_UNROLL
  for (int a = 0; a < 6; ++a) terms[term++] += wr * jacobian[a];
  terms[term] += wr * residual;
}

// Unpacks the 28 terms into a full symmetric hessian, a gradient and a cost.
template <class T>
SPS_INLINE void store_normal_terms(const double* terms, T* hessian, T* gradient, T* cost) {
  int term = 0;
  SPS_UNROLL
  for (int a = 0; a < 6; ++a) {
    SPS_UNROLL
    for (int b = a; b < 6; ++b) hessian[a * 6 + b] = hessian[b * 6 + a] = static_cast<T>(terms[term++]);
  }
  SPS_UNROLL
  for (int a = 0; a < 6; ++a) gradient[a] = static_cast<T>(terms[term++]);
  *cost = static_cast<T>(terms[term]);
}

// delta = -(H + damping diag(H) + absolute_damping I)^-1 g by LDL^T without pivoting. `tolerance` is the share of a
// diagonal entry that must be left after elimination for the matrix to count as positive definite.
template <class T>
SPS_INLINE void solve_damped_6x6(const T* hessian, const T* gradient, double damping, double absolute_damping,
                                 double tolerance, T* delta) {
  double l[6][6], d[6], inverse[6], x[6];
  bool solvable = true;
  // Unrolled, as registers have no addresses; the only divisions are the six reciprocals of the diagonal.
  SPS_UNROLL
  for (int a = 0; a < 6; ++a) {
    SPS_UNROLL
    for (int b = 0; b <= a; ++b) {
      double sum = static_cast<double>(hessian[a * 6 + b]);
      double bound = 0.0;
      if (a == b) {
        sum += damping * sum + absolute_damping;
        bound = tolerance * sum;
      }
      SPS_UNROLL
      for (int k = 0; k < b; ++k) sum -= l[a][k] * l[b][k] * d[k];
      if (a == b) {
        d[a] = sum;
        inverse[a] = 1.0 / sum;
        solvable = solvable && sum > bound && std::isfinite(sum);
      } else {
        l[a][b] = sum * inverse[b];
      }
    }
  }
  SPS_UNROLL
  for (int a = 0; a < 6; ++a) {
    x[a] = -static_cast<double>(gradient[a]);
    SPS_UNROLL
    for (int k = 0; k < a; ++k) x[a] -= l[a][k] * x[k];
  }
  SPS_UNROLL
  for (int a = 5; a >= 0; --a) {
    x[a] *= inverse[a];
    SPS_UNROLL
    for (int k = a + 1; k < 6; ++k) x[a] -= l[k][a] * x[k];
    solvable = solvable && std::isfinite(x[a]);
  }
  SPS_UNROLL
  for (int a = 0; a < 6; ++a) delta[a] = solvable ? static_cast<T>(x[a]) : T(0);
}

}  // namespace spslam
