#include "kernels/sensor_noise.h"

#include <algorithm>

#include "core/parallel.h"
#include "cpu/keyframe_prefetch.h"

namespace spslam {
namespace {

constexpr std::int64_t kPixelGrain = 256;

}  // namespace

template <>
void measure_noise<Cpu>(Cpu, const std::int32_t* pixels, std::int64_t num_pixels, const float* pose,
                        const Intrinsics& intrinsics, const DepthKeyframes& keyframes, std::int32_t* counts,
                        float* noise) {
  const Pose<float> T_world_camera = load_pose(pose);
  DepthKeyframe loaded[kMaxDepthKeyframes];
  for (int k = 0; k < keyframes.count; ++k) loaded[k] = load_depth_keyframe(keyframes, k);
  const ColorPose color = color_pose(keyframes.poses, keyframes.frame_motion, keyframes.color_delay, pose);
  // Whole numbers: their sums do not depend on the order.
  const auto add = [counts](std::int64_t at) { __atomic_fetch_add(counts + at, kResidualCount, __ATOMIC_RELAXED); };
  parallel_for(num_pixels, kPixelGrain, [&](std::int64_t begin, std::int64_t end) {
    Pixel ahead[kPointsAhead];
    PixelPoints points[kPointsAhead];
    for (std::int64_t first = begin; first < end; first += kPointsAhead) {
      int count = 0;
      for (std::int64_t i = first; i < std::min(first + kPointsAhead, end); ++i) {
        const Pixel pixel = unpack_pixel(pixels + kPixelWords * i);
        if (!(pixel.depth > 0.0f)) continue;
        ahead[count] = pixel;
        points[count] = pixel_points(pixel, surface_point(pixel, T_world_camera, intrinsics), color, intrinsics);
        for (int k = 0; k < keyframes.count; ++k) prefetch_keyframe(keyframes, loaded[k], points[count].depth.world);
        ++count;
      }
      for (int p = 0; p < count; ++p) {
        for (int k = 0; k < keyframes.count; ++k) count_residuals(keyframes, loaded[k], ahead[p], points[p], add);
      }
    }
  });
  for (int histogram = 0; histogram < kNoiseHistograms; ++histogram) {
    BinVariance bins[kNoiseBins];
    for (int b = 0; b < kNoiseBins; ++b) {
      bins[b] = bin_variance(counts + (std::int64_t{histogram} * kNoiseBins + b) * kNoiseLevels, histogram);
    }
    fit_noise(bins, histogram, noise + 2 * histogram);
  }
  for (std::int64_t i = 0; i < kNoiseCounts; ++i) counts[i] -= counts[i] >> kFadeShift;
}

}  // namespace spslam
