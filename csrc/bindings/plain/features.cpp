// Image features and what they say of poses, for Python by ctypes.
#include <algorithm>
#include <new>
#include <vector>

#include "bindings/plain/export.h"
#include "spslam/feature_pose.h"
#include "spslam/orb_features.h"
#include "spslam/rolling_shutter.h"

namespace {

spslam::FeatureCamera camera_of(const double* k) {
  return {k[0], k[1], k[2], k[3]};
}

std::int64_t store(const spslam::FeatureEquations& found, double* equations) {
  std::copy(found.hessian, found.hessian + 36, equations);
  std::copy(found.gradient, found.gradient + 6, equations + 36);
  return found.agreeing;
}

}  // namespace

// size: rows and columns. options: those of `OrbOptions` in its order. Returns how many features there are, or -1 where
// there is not enough memory.
SPS_EXPORT std::int64_t spslam_orb_features(const std::uint8_t* intensity, const std::int32_t* size,
                                            const std::int32_t* options, float* positions, std::uint8_t* descriptors) {
  try {
    return spslam::orb_features(spslam::Cpu{}, intensity, size[0], size[1],
                                {options[0], options[1], options[2], options[3], options[4]}, positions, descriptors);
  } catch (const std::bad_alloc&) {
    return -1;
  }
}

// seen: points, positions, deviations. camera: fx, fy, cx, cy. equations: hessian and gradient [42]. Returns how many
// points agree.
SPS_EXPORT std::int64_t spslam_point_equations(const double* const* seen, std::int64_t count, const double* camera,
                                               const double* pose, double error_px, double* equations) {
  const spslam::SeenPoints points{seen[0], seen[1], seen[2], count};
  return store(spslam::point_equations(spslam::Cpu{}, points, camera_of(camera), pose, error_px), equations);
}

// agrees: bool [count].
SPS_EXPORT void spslam_agreeing_points(const double* const* seen, std::int64_t count, const double* camera,
                                       const double* pose, double error_px, bool* agrees) {
  const spslam::SeenPoints points{seen[0], seen[1], seen[2], count};
  spslam::agreeing_points(spslam::Cpu{}, points, camera_of(camera), pose, error_px, agrees);
}

// seen: origin, directions, positions, range.
SPS_EXPORT std::int64_t spslam_ray_equations(const double* const* seen, std::int64_t count, const double* camera,
                                             const double* pose, double error_px, std::int64_t least,
                                             double* equations) {
  const spslam::SeenRays rays{seen[0], seen[1], seen[2], seen[3], count};
  return store(spslam::ray_equations(spslam::Cpu{}, rays, camera_of(camera), pose, error_px, least), equations);
}

// seen: points, positions, deviations, then origin, directions, positions and range of each earlier frame with rays;
// counts [1 + groups] of them. frame: camera, pose [7], information [36], the pose before, which may be null, and two
// numbers: share of the motion, error_px. Returns how many points agreed, -1 where these were fewer than least and -2
// where there is not enough memory.
SPS_EXPORT std::int64_t spslam_hold_pose(const double* const* seen, const std::int64_t* counts, std::int64_t groups,
                                         const double* const* frame, std::int64_t least, double* held) {
  try {
    std::vector<spslam::SeenRays> rays;
    for (std::int64_t i = 0; i < groups; ++i) {
      const double* const* of = seen + 3 + 4 * i;
      rays.push_back({of[0], of[1], of[2], of[3], counts[1 + i]});
    }
    const double* numbers = frame[4];
    return spslam::hold_pose(spslam::Cpu{}, {seen[0], seen[1], seen[2], counts[0]}, rays.data(), groups,
                             camera_of(frame[0]), {frame[3], numbers[0]}, frame[1], frame[2], {numbers[1], least},
                             held);
  } catch (const std::bad_alloc&) {
    return -2;
  }
}

// motion: poses before and after [14], readout and seconds (s). camera: fx, fy, cx, cy of the image, and its rows.
SPS_EXPORT void spslam_rectify_features(const float* positions, const float* points, std::int64_t count,
                                        const float* motion, const float* camera, float* out_positions,
                                        float* out_points) {
  const spslam::Intrinsics k{camera[0], camera[1], camera[2], camera[3]};
  spslam::rectify_shutter_features(spslam::Cpu{}, positions, points, count,
                                   {motion, motion + 7, motion + 14, motion[15]},
                                   {k, static_cast<std::int64_t>(camera[4]), 0}, out_positions, out_points);
}
