#include "launch/track_adam.h"

namespace spslam {

template <>
std::int64_t track_adam_workspace_size(Cpu device, const PoseTracking& call) {
  return TrackAdamLaunch<Cpu>(device, call, nullptr).bytes();
}

template <>
void track_adam(Cpu device, const PoseTracking& call, void* workspace, LaunchGraph*) {
  TrackAdamLaunch<Cpu>(device, call, workspace).run();
}

}  // namespace spslam
