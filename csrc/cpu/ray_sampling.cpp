#include "kernels/ray_sampling_launch.h"

namespace spslam {
SPS_INSTANTIATE_RAY_SAMPLING(Cpu)
}  // namespace spslam
