#include "launch/track_frame.h"

namespace spslam {

template <>
std::int64_t track_frame_workspace_size(Cuda device, const FrameTracking& call) {
  return TrackFrameLaunch<Cuda>(device, call, nullptr).bytes();
}

template <>
void track_frame(Cuda device, const FrameTracking& call, void* workspace, const TrackedFrameOutput& out) {
  TrackFrameLaunch<Cuda>(device, call, workspace).run(out);
}

}  // namespace spslam
