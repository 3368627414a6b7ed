// Which frames see what another one sees.
#pragma once

#include <cstdint>

#include "core/device.h"
#include "core/philox.h"
#include "spslam/types/camera.h"

namespace spslam {

// What co-visibility knows of frames: their poses, and depth thumbnails, whose cells hold the depth at their middle.
struct FrameThumbnails {
  const float* poses;                     // [num_frames, 7]
  const std::uint16_t* depth_thumbnails;  // [num_frames, rows, columns] bits of float16, m; 0 where unknown
  std::int64_t num_frames, rows, columns;
  Intrinsics intrinsics;  // of the image, px
  std::int64_t step;      // px, side of a depth thumbnail cell
};

// share [num_frames]: of the world points [num_points, 3] (m), how many each frame sees at the depth it measured.
template <class Device>
void frame_overlap(Device device, const float* points, std::int64_t num_points, const FrameThumbnails& frames,
                   float* share);

struct CovisibleSelection {
  std::int64_t current;        // row of the frame that the others are compared with
  std::int64_t num_points;     // drawn from the current frame's records
  std::int64_t num_covisible;  // most frames that are taken for being co-visible
  std::int64_t count;          // frames to select, at most the number of candidates
  double threshold;            // share of the points that a co-visible frame sees more than
  PhiloxKey key;               // of the draw of points
};

template <class Device>
std::int64_t covisible_workspace_size(Device device, const FrameThumbnails& frames, std::int64_t num_candidates,
                                      const CovisibleSelection& selection);

// selected [count], ascending: the first co-visible of the candidates [num_candidates] (rows in order of preference),
// then the first of the others. A row out of range is no frame, and one that comes twice counts once: the end of
// selected is -1 then. records [num_records, 3] are the current frame's pixels.
template <class Device>
void select_covisible_frames(Device device, const std::int32_t* records, std::int64_t num_records,
                             const FrameThumbnails& frames, const std::int64_t* candidates, std::int64_t num_candidates,
                             const CovisibleSelection& selection, void* workspace, std::int64_t* selected);

}  // namespace spslam
