#include "kernels/volume_rendering_launch.h"

namespace spslam {
SPS_INSTANTIATE_VOLUME_RENDERING(Cpu, float)
SPS_INSTANTIATE_VOLUME_RENDERING(Cpu, double)
}  // namespace spslam
