#include "spslam/covisibility.h"

#include <algorithm>

#include "core/parallel.h"
#include "kernels/covisibility.h"

namespace spslam {
namespace {

constexpr std::int64_t kFrameGrain = 8;
// Candidates tested at a time, until there are enough: of thousands, most need not be.
constexpr std::int64_t kCandidatesAtOnce = 128;

std::int64_t count_seen(const FrameThumbnails& frames, std::int64_t frame, const Vec3<double>* points,
                        std::int64_t num_points) {
  const Pose<double> pose = load_frame_pose(frames.poses + kPoseSize * frame);
  std::int64_t seen = 0;
  for (std::int64_t i = 0; i < num_points; ++i) seen += sees_point(frames, frame, pose, points[i]);
  return seen;
}

// taken[i] = 1 for the first co-visible candidates; returns how many.
std::int64_t take_covisible(const FrameThumbnails& frames, const std::int64_t* candidates, std::int64_t num_candidates,
                            const CovisibleSelection& selection, const Vec3<double>* points, std::int64_t wanted,
                            std::uint8_t* taken) {
  const std::int64_t enough = covisible_count(selection);
  std::int64_t found = 0;
  for (std::int64_t first = 0; first < num_candidates && found < wanted; first += kCandidatesAtOnce) {
    const std::int64_t count = std::min(kCandidatesAtOnce, num_candidates - first);
    bool covisible[kCandidatesAtOnce];
    parallel_for(count, kFrameGrain, [&](std::int64_t begin, std::int64_t end) {
      for (std::int64_t i = begin; i < end; ++i) {
        const std::int64_t row = candidates[first + i];
        covisible[i] = is_frame(frames, row) && count_seen(frames, row, points, selection.num_points) >= enough;
      }
    });
    for (std::int64_t i = 0; i < count && found < wanted; ++i) {
      taken[first + i] = covisible[i];
      found += covisible[i];
    }
  }
  return found;
}

}  // namespace

template <>
void frame_overlap<Cpu>(Cpu, const float* points, std::int64_t num_points, const FrameThumbnails& frames,
                        float* share) {
  parallel_for(frames.num_frames, kFrameGrain, [&](std::int64_t begin, std::int64_t end) {
    for (std::int64_t f = begin; f < end; ++f) {
      const Pose<double> pose = load_frame_pose(frames.poses + kPoseSize * f);
      std::int64_t seen = 0;
      for (std::int64_t i = 0; i < num_points; ++i) {
        seen += sees_point(frames, f, pose, {points[3 * i], points[3 * i + 1], points[3 * i + 2]});
      }
      share[f] = num_points ? static_cast<float>(static_cast<double>(seen) / static_cast<double>(num_points)) : 0.0f;
    }
  });
}

template <>
std::int64_t covisible_workspace_size<Cpu>(Cpu, const FrameThumbnails&, std::int64_t num_candidates,
                                           const CovisibleSelection& selection) {
  return selection.num_points * static_cast<std::int64_t>(sizeof(Vec3<double>)) + num_candidates;
}

template <>
void select_covisible_frames<Cpu>(Cpu, const std::int32_t* records, std::int64_t num_records,
                                  const FrameThumbnails& frames, const std::int64_t* candidates,
                                  std::int64_t num_candidates, const CovisibleSelection& selection, void* workspace,
                                  std::int64_t* selected) {
  Vec3<double>* points = static_cast<Vec3<double>*>(workspace);
  std::uint8_t* taken = reinterpret_cast<std::uint8_t*>(points + selection.num_points);
  const Pose<double> pose = load_frame_pose(frames.poses + kPoseSize * selection.current);
  for (std::int64_t i = 0; i < selection.num_points; ++i) {
    const std::int64_t at = philox_index(selection.key, static_cast<std::uint32_t>(i), num_records);
    points[i] = pixel_point(records + kPixelWords * at, pose, frames.intrinsics);
  }
  std::fill_n(taken, num_candidates, std::uint8_t{0});
  const std::int64_t wanted = std::min(selection.num_covisible, selection.count);
  std::int64_t found = take_covisible(frames, candidates, num_candidates, selection, points, wanted, taken);
  for (std::int64_t i = 0; i < num_candidates && found < selection.count; ++i) {
    found += !taken[i];
    taken[i] = 1;
  }
  std::int64_t* end = selected;
  for (std::int64_t i = 0; i < num_candidates; ++i) {
    if (taken[i] && is_frame(frames, candidates[i])) *end++ = candidates[i];
  }
  std::sort(selected, end);
  std::fill(std::unique(selected, end), selected + selection.count, std::int64_t{-1});
}

}  // namespace spslam
