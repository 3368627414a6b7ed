#include "kernels/capture_timing.h"

#include <algorithm>

#include "cpu/keyframe_prefetch.h"
#include "cpu/term_sums.h"

namespace spslam {
namespace {

constexpr std::int64_t kPixelGrain = 256;

}  // namespace

template <>
std::int64_t capture_timing_workspace_size<Cpu>(Cpu, std::int64_t num_pixels, std::int64_t) {
  return chunk_count(num_pixels, kPixelGrain) * kTimingTerms * static_cast<std::int64_t>(sizeof(double));
}

template <>
void measure_capture_timing<Cpu>(Cpu, const std::int32_t* pixels, std::int64_t num_pixels, const float* pose,
                                 const Intrinsics& intrinsics, const float* noise, const DepthKeyframes& keyframes,
                                 void* workspace, double* state, float* timing) {
  const SensorNoise sensor = load_sensor_noise(noise);
  const MovingFrame frame = load_moving_frame(keyframes, pose);
  TimingEvidence all{};
  for (int k = 0; k < keyframes.count; ++k) {
    const MovingKeyframe keyframe = load_moving_keyframe(keyframes, k, timing);
    double terms[kTimingTerms];
    const auto add = [&](std::int64_t begin, std::int64_t end, double* own) {
      for (std::int64_t first = begin; first < end; first += kPointsAhead) {
        const std::int64_t last = std::min(first + kPointsAhead, end);
        for (std::int64_t i = first; i < last; ++i) {
          const Pixel pixel = unpack_pixel(pixels + kPixelWords * i);
          prefetch_keyframe(keyframes, keyframe.keyframe, surface_point(pixel, frame.pose, intrinsics).world);
        }
        for (std::int64_t i = first; i < last; ++i) {
          add_timing_residuals(keyframes, keyframe, frame, unpack_pixel(pixels + kPixelWords * i), intrinsics, sensor,
                               own);
        }
      }
    };
    sum_terms<kTimingTerms>(num_pixels, kPixelGrain, static_cast<double*>(workspace), terms, add);
    add_timing_evidence(terms, all);
  }
  update_capture_timing(all, state, timing);
}

}  // namespace spslam
