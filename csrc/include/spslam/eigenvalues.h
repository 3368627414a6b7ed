// Eigenvalues of small symmetric matrices, on the host: how well equations determine what they are of.
#pragma once

#include "core/device.h"

namespace spslam {

// The least eigenvalue of a symmetric matrix [6, 6], to the last bits of the largest one; NaN where an entry is not
// finite.
double least_eigenvalue(Cpu device, const double* matrix);

}  // namespace spslam
