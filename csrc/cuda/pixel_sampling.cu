#include "launch/pixel_sampling.h"

namespace spslam {

SPS_INSTANTIATE_PIXEL_SAMPLING(Cuda)

}  // namespace spslam
