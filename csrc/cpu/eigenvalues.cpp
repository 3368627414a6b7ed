// Cyclic Jacobi rotations (Golub and Van Loan, Matrix Computations, 8.5).
#include "spslam/eigenvalues.h"

#include <algorithm>
#include <cmath>
#include <limits>

namespace spslam {
namespace {

constexpr int kSize = 6;
constexpr int kMostSweeps = 20;  // six do: they converge quadratically

}  // namespace

double least_eigenvalue(Cpu, const double* matrix) {
  double a[kSize][kSize];
  for (int i = 0; i < kSize * kSize; ++i) {
    if (!std::isfinite(matrix[i])) return std::numeric_limits<double>::quiet_NaN();
    a[i / kSize][i % kSize] = matrix[i];
  }
  for (int sweep = 0; sweep < kMostSweeps; ++sweep) {
    double off = 0.0, most = 0.0;
    for (int p = 0; p < kSize; ++p) {
      most = std::max(most, std::fabs(a[p][p]));
      for (int q = p + 1; q < kSize; ++q) off = std::max(off, std::fabs(a[p][q]));
    }
    if (off <= std::numeric_limits<double>::epsilon() * 0.01 * most) break;
    for (int p = 0; p < kSize; ++p) {
      for (int q = p + 1; q < kSize; ++q) {
        if (a[p][q] == 0.0) continue;
        // The rotation by the smaller angle that makes a[p][q] zero.
        const double slope = 0.5 * (a[q][q] - a[p][p]) / a[p][q];
        const double t = std::copysign(1.0 / (std::fabs(slope) + std::hypot(slope, 1.0)), slope);
        const double c = 1.0 / std::sqrt(t * t + 1.0), s = t * c;
        a[p][p] -= t * a[p][q];
        a[q][q] += t * a[p][q];
        a[p][q] = a[q][p] = 0.0;
        for (int i = 0; i < kSize; ++i) {
          if (i == p || i == q) continue;
          const double ip = a[i][p], iq = a[i][q];
          a[i][p] = a[p][i] = c * ip - s * iq;
          a[i][q] = a[q][i] = s * ip + c * iq;
        }
      }
    }
  }
  double least = a[0][0];
  for (int i = 1; i < kSize; ++i) least = std::min(least, a[i][i]);
  return least;
}

}  // namespace spslam
