// What the next pose is predicted from.
#pragma once

namespace spslam {

// How a camera came to its last pose, and when it is looked for again.
struct RecentMotion {
  const float *before, *last;  // [7] T_world_camera of two frames
  float steps;                 // time from `last` to the next frame, in times from `before` to `last`
};

}  // namespace spslam
