#include "kernels/pixel_sampling_launch.h"

namespace spslam {

SPS_INSTANTIATE_PIXEL_SAMPLING(Cuda)

}  // namespace spslam
