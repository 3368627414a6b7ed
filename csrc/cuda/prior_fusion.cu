#include "kernels/prior_fusion_launch.h"

namespace spslam {
SPS_INSTANTIATE_PRIOR_FUSION(Cuda)
}  // namespace spslam
