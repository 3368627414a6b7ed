#include "kernels/volume_rendering_launch.h"

namespace spslam {
SPS_INSTANTIATE_VOLUME_RENDERING(Cuda, float)
SPS_INSTANTIATE_VOLUME_RENDERING(Cuda, double)
}  // namespace spslam
