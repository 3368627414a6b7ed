// What normal equations say of poses, for Python by ctypes.
#include "bindings/plain/export.h"
#include "spslam/eigenvalues.h"

// The least eigenvalue of a symmetric matrix [6, 6]; NaN where an entry is not finite.
SPS_EXPORT double spslam_least_eigenvalue(const double* matrix) {
  return spslam::least_eigenvalue(spslam::Cpu{}, matrix);
}
