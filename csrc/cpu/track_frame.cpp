#include "launch/track_frame.h"

namespace spslam {

template <>
std::int64_t track_frame_workspace_size(Cpu device, const FrameTracking& call) {
  return TrackFrameLaunch<Cpu>(device, call, nullptr).bytes();
}

template <>
void track_frame(Cpu device, const FrameTracking& call, void* workspace, const TrackedFrameOutput& out) {
  TrackFrameLaunch<Cpu>(device, call, workspace).run(out);
}

}  // namespace spslam
