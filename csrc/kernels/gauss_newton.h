// The maths of Gauss-Newton tracking: what one pixel is measured against, and the step that the sums over pixels give.
#pragma once

#include <cmath>
#include <cstdint>

#include "core/macros.h"
#include "core/vec.h"
#include "kernels/depth_keyframes.h"
#include "kernels/pixel_noise.h"
#include "kernels/pixel_record.h"
#include "kernels/reference_image.h"
#include "kernels/robust_residual.h"
#include "kernels/surface_point.h"
#include "spslam/gauss_newton.h"

namespace spslam {

// Of the gain, by the reference image and by the depth keyframes.
constexpr int kAllGainTerms = 2 * kGainTerms;
// Terms of the map and, after them, of the depth keyframes and of the gain.
constexpr int kJointTerms = kTrackingTerms + kKeyframeTerms + kAllGainTerms;
// Beyond this the decoder's tanh is saturated and its slope says nothing about where the surface is.
constexpr float kSaturatedSdf = 0.98f;
constexpr float kMaxTrackingStep = 0.15f;  // norm of (dt in m, domega in rad)
constexpr double kMaxGainStep = 0.2;       // of the logarithm, in one iteration
// As many a frame's pixels are worth for its gain: what is wrong with their brightness is alike for neighbors.
constexpr double kIndependentPixels = 300.0;
constexpr double kGainEvidence = 1.0 / 16;   // share of a frame in the variance of the steps of the gain
constexpr double kLeastGainVariance = 1e-8;  // 0.01 %, less than any pixel shows

// The gain of the frame that is tracked, and what is known of it without its own pixels.
struct FrameGain {
  float log_gain;  // as the running iteration has it
  float before;    // where it is expected
  float variance;  // of the step from there
  double unit;     // m^2; over it, the pixels' sum of squares is an information. 0: the gain may be any
};

// The earlier frames that a call compares with and the sensor's noise, read once.
struct EarlierFrames {
  SensorNoise noise;
  Pose<float> reference;  // where its colors were taken
  float reference_scale;  // as of DepthKeyframe
  DepthKeyframe keyframes[kMaxDepthKeyframes];
  // Of the frame itself, as the running iteration has them.
  ColorPose color;
  FrameGain gain;
};
constexpr int kMaxEarlierFrames = 1 + kMaxDepthKeyframes;

// Where the noise of intensities is not known, nothing says how much the frame's pixels are worth against a variance.
SPS_INLINE FrameGain load_frame_gain(const GaussNewtonOptions& options) {
  const DepthKeyframes& keyframes = options.depth_keyframes;
  const float expected = *keyframes.frame_log_gain;
  if (!keyframes.gain_variance) return {expected, expected, 0.0f, 0.0};
  double unit = 0.0;
  if (options.noise) {
    const double meters = static_cast<double>(intensity_meters(load_sensor_noise(options.noise)));
    unit = meters * meters * static_cast<double>(options.num_pixels) / kIndependentPixels;
  }
  return {expected, expected, *keyframes.gain_variance, unit};
}

// Reads number i of kMaxEarlierFrames, if there is one: the reference image is 0, the depth keyframes follow.
SPS_INLINE void load_earlier_frame(const GaussNewtonOptions& options, int i, EarlierFrames& frames) {
  const ReferenceImage& reference = options.reference;
  const DepthKeyframes& keyframes = options.depth_keyframes;
  if (i == 0 && reference.height > 0) {
    frames.reference = color_pose(keyframes.poses, reference.motion, keyframes.color_delay, reference.pose).pose;
    frames.reference_scale = 1.0f;
  }
  if (i == 0 && options.noise) frames.noise = load_sensor_noise(options.noise);
  if (i == 0 && keyframes.log_gains) frames.gain = load_frame_gain(options);
  if (i > 0 && i <= keyframes.count) frames.keyframes[i - 1] = load_depth_keyframe(keyframes, i - 1);
}

// What the frame's pose [7] and gain, as the last iteration found them, mean for its colors.
SPS_INLINE void load_colors(const GaussNewtonOptions& options, const float* pose, EarlierFrames& frames) {
  const DepthKeyframes& keyframes = options.depth_keyframes;
  frames.color = color_pose(keyframes.poses, keyframes.frame_motion, keyframes.color_delay, pose);
  if (!keyframes.log_gains) return;
  for (int k = 0; k < keyframes.count; ++k) {
    frames.keyframes[k].scale = brightness_scale(frames.keyframes[k].log_gain, frames.gain.log_gain);
  }
  if (options.reference.log_gain) {
    frames.reference_scale = brightness_scale(*options.reference.log_gain, frames.gain.log_gain);
  }
}

// What the pixels of an iteration are measured against. It points to what all iterations and threads share.
struct Measurement {
  const GaussNewtonOptions* options;
  const EarlierFrames* frames;  // not read where there are neither a reference nor depth keyframes
  int num_keyframes;            // that take part in the iteration
  KernelWidths kernel;
};

// Adds an inlier's residual against the map, from its normalized SDF and the SDF's gradient by the world point (1/m).
template <class T>
SPS_INLINE void add_map_residual(const Measurement& measure, const Vec3<float>& offset, float sdf,
                                 const Vec3<float>& gradient, float certainty, T* terms) {
  const float truncation = measure.options->truncation;
  add_robust_residual(offset, sdf * truncation, truncation * gradient, measure.kernel, certainty, terms);
}

SPS_INLINE PixelNoise noise_of(const Measurement& measure, const Pixel& pixel) {
  const SensorNoise* sensor = measure.options->noise ? &measure.frames->noise : nullptr;
  return pixel_noise(sensor, pixel.depth, luma(pixel.color));
}

// Adds a point's residuals against every stride-th depth keyframe of the iteration, from `first` on.
template <class T>
SPS_INLINE void add_keyframe_residuals(const Measurement& measure, const Pixel& pixel, const SurfacePoint& point,
                                       const PixelNoise& noise, const MapResidual& map, int first, int stride, T* terms,
                                       T* gain_terms) {
  if (measure.num_keyframes == 0) return;
  const PixelPoints points = pixel_points(pixel, point, measure.frames->color, measure.options->intrinsics);
  for (int k = first; k < measure.num_keyframes; k += stride) {
    add_depth_keyframe_residual(measure.options->depth_keyframes, measure.frames->keyframes[k], points,
                                measure.kernel.keyframe, noise, map, terms, gain_terms);
  }
}

// Adds a pixel's residual against the reference image, where there is one.
template <class T>
SPS_INLINE void add_reference_residual(const Measurement& measure, const Pixel& pixel, const SurfacePoint& point,
                                       T* terms, T* gain_terms) {
  const ReferenceImage& reference = measure.options->reference;
  if (reference.height == 0) return;
  const PixelPoints points = pixel_points(pixel, point, measure.frames->color, measure.options->intrinsics);
  add_intensity_residual(reference, measure.frames->reference, measure.frames->reference_scale, pixel, points.color,
                         1.0f + points.lever, terms, gain_terms);
}

SPS_INLINE bool is_tracking_inlier(float depth, bool inside, float sdf) {
  return depth > 0.0f && inside && std::fabs(sdf) < kSaturatedSdf;
}

// Width of the robust kernel in an iteration: geometric from start to end, which it reaches one iteration before the
// last.
SPS_INLINE float annealed_kernel(float start, float end, std::int64_t iteration, std::int64_t iterations) {
  const float steps = static_cast<float>(iterations > 2 ? iterations - 2 : 1);
  const float progress = static_cast<float>(iteration) / steps;
  return start * std::pow(end / start, progress < 1.0f ? progress : 1.0f);
}

// The widths in an iteration; the score's is that of the step where options name none.
SPS_INLINE KernelWidths tracking_kernel(const GaussNewtonOptions& options, std::int64_t iteration) {
  const float step = annealed_kernel(options.kernel_start, options.kernel_end, iteration, options.iterations);
  const float keyframe =
      options.depth_keyframes.count > 0
          ? annealed_kernel(options.kernel_start, options.depth_keyframes.kernel_end, iteration, options.iterations)
          : step;
  return {step, options.score_kernel > 0.0f ? options.score_kernel : step, keyframe};
}

// Options under which all given pixels are measured against the map alone, with one width of the kernel.
SPS_INLINE GaussNewtonOptions map_options(const Intrinsics& intrinsics, float truncation, float kernel) {
  GaussNewtonOptions options{};
  options.intrinsics = intrinsics;
  options.iterations = 1;
  options.truncation = truncation;
  options.kernel_start = options.kernel_end = options.score_kernel = kernel;
  return options;
}

// `frames` may be null where options have neither a reference nor depth keyframes.
SPS_INLINE Measurement measurement(const GaussNewtonOptions& options, const EarlierFrames* frames,
                                   std::int64_t iteration) {
  return {&options, frames, keyframes_in_use(options.depth_keyframes, iteration), tracking_kernel(options, iteration)};
}

// Weighted mean squared residual, m^2.
SPS_INLINE double tracking_cost(const double* terms) {
  const double weights = terms[kNormalTerms];
  return weights > 1e-6 ? terms[kNormalTerms - 1] / weights : 0.0;
}

// What holds the directions of little information while the map alone moves the pose, as an absolute damping.
SPS_INLINE double held_damping(const Measurement& measure, const double* terms) {
  const GaussNewtonOptions& options = *measure.options;
  const bool waits = measure.num_keyframes < options.depth_keyframes.count;
  return waits ? options.held_information * terms[kNormalTerms + 2] : 0.0;
}

// What the equations of the frame's gain, and where it is expected, leave of those of the pose; the gain's step once
// the pose's is known.
struct GainEquations {
  const double* terms;              // [kGainTerms] of the pixels
  double gradient, inverse;         // with what is expected; the inverse of the information is 0 where there is none
  double innovation, own_variance;  // by how much the pixels alone would have it otherwise, and how well they know

  SPS_INLINE GainEquations(const double* of, const FrameGain& gain)
      : terms(of), gradient(of[7]), inverse(0.0), innovation(0.0), own_variance(0.0) {
    const double information = of[6], moved = static_cast<double>(gain.log_gain) - static_cast<double>(gain.before);
    double expected = 0.0;
    if (information > kLeastInformation) {
      innovation = moved - of[7] / information;
      own_variance = gain.unit / information;
      // A step that is far larger than those before counts for itself: exposure may change at once.
      const double variance = static_cast<double>(gain.variance) + kGainEvidence * innovation * innovation;
      expected = gain.unit / (variance > kLeastGainVariance ? variance : kLeastGainVariance);
      inverse = 1.0 / (information + expected);
    }
    gradient += expected * moved;
  }

  SPS_INLINE void eliminate(double (&h)[36], double (&g)[6]) const {
    for (int a = 0; a < 6; ++a) {
      for (int b = 0; b < 6; ++b) h[6 * a + b] -= inverse * terms[a] * terms[b];
      g[a] -= inverse * terms[a] * gradient;
    }
  }

  SPS_INLINE double step(const float* pose_step) const {
    double left = gradient;
    for (int a = 0; a < 6; ++a) left += terms[a] * static_cast<double>(pose_step[a]);
    const double wanted = -inverse * left;
    return wanted > kMaxGainStep ? kMaxGainStep : wanted > -kMaxGainStep ? wanted : -kMaxGainStep;
  }

  // The variance of steps, this one included: of its square what is more than the pixels' noise.
  SPS_INLINE float variance_after(const FrameGain& gain) const {
    const double before = static_cast<double>(gain.variance), square = innovation * innovation - own_variance;
    if (inverse == 0.0 || gain.unit == 0.0) return gain.variance;
    const double after = before + kGainEvidence * ((square > 0.0 ? square : 0.0) - before);
    return static_cast<float>(after > kLeastGainVariance ? after : kLeastGainVariance);
  }

 private:
  static constexpr double kLeastInformation = 1e-12;
};

// Solves the joint normal equations, with `held` added to the diagonal, and moves the pose and, unless it is null, the
// gain, whose equations `joint` then has too. `steps` gets |dt| (m) and |domega| (rad). `hessian` gets the map's matrix
// as if pixels had on average their score weights and no certainties: it says how firmly the surface holds the pose,
// whatever its distance and the width of the kernel.
SPS_INLINE void tracking_step(const double* terms, const double* joint, double damping, double held, float* pose,
                              float* steps, float* hessian, FrameGain* gain = nullptr) {
  double h[36], g[6], cost, delta[6];
  store_normal_terms<double>(joint, h, g, &cost);
  if (gain) GainEquations(joint + kNormalTerms, *gain).eliminate(h, g);
  double trace = 0.0;
  for (int a = 0; a < 6; ++a) trace += h[a * 7];
  // The absolute part keeps directions that no pixel sees from moving.
  solve_damped_6x6<double>(h, g, damping, 1e-6 * trace + 1e-8 + held, 1e-12, delta);
  float step[6], norm = 0.0f;
  for (int a = 0; a < 6; ++a) step[a] = static_cast<float>(delta[a]), norm += step[a] * step[a];
  norm = std::sqrt(norm);
  const float scale = norm > kMaxTrackingStep ? kMaxTrackingStep / norm : 1.0f;
  for (int a = 0; a < 6; ++a) step[a] *= scale;
  if (gain) gain->log_gain += static_cast<float>(GainEquations(joint + kNormalTerms, *gain).step(step));
  const Vec3<float> dt{step[0], step[1], step[2]}, domega{step[3], step[4], step[5]};
  const Quaternion<float> q =
      normalized(quaternion_exp(domega) * Quaternion<float>{pose[0], pose[1], pose[2], pose[3]});
  pose[0] = q.w, pose[1] = q.x, pose[2] = q.y, pose[3] = q.z;
  pose[4] += dt.x, pose[5] += dt.y, pose[6] += dt.z;
  steps[0] = std::sqrt(dot(dt, dt));
  steps[1] = std::sqrt(dot(domega, domega));
  const double certain = terms[kNormalTerms + 2], share = certain > 0.0 ? terms[kNormalTerms] / certain : 1.0;
  store_normal_terms<double>(terms, h, g, &cost);
  for (int i = 0; i < 36; ++i) hessian[i] = static_cast<float>(share * h[i]);
}

// The last two statistics of an iteration: the log gain, and the variance of its steps by the equations that moved it.
// Before the step.
SPS_INLINE float gain_variance(const double* joint, const FrameGain& gain) {
  return GainEquations(joint + kNormalTerms, gain).variance_after(gain);
}

// Cost, inlier share and mean score weight of the pose before its step: columns 0, 1 and 4 of its statistics.
SPS_INLINE void tracking_fit(const double* terms, std::int64_t num_pixels, float* stats) {
  const double count = static_cast<double>(num_pixels > 0 ? num_pixels : 1);
  stats[0] = static_cast<float>(tracking_cost(terms));
  stats[1] = static_cast<float>(terms[kNormalTerms + 1] / count);
  stats[4] = static_cast<float>(terms[kNormalTerms] / count);
}

// Writes the sums over a frame's pixels as its normal equations.
SPS_INLINE void store_pose_equations(const double* terms, std::int64_t frame, std::int64_t num_pixels,
                                     const PoseEquations& out) {
  double h[36], g[6], cost;
  store_normal_terms<double>(terms, h, g, &cost);
  for (int i = 0; i < 36; ++i) out.hessian[36 * frame + i] = static_cast<float>(h[i]);
  for (int i = 0; i < 6; ++i) out.gradient[6 * frame + i] = static_cast<float>(g[i]);
  out.cost[frame] = static_cast<float>(tracking_cost(terms));
  const double share = num_pixels ? terms[kNormalTerms + 1] / static_cast<double>(num_pixels) : 0.0;
  out.inliers[frame] = static_cast<float>(share);
}

// Where a camera that moves on as it did from T0 to T1 is `steps` such times later, (T1 T0^-1)^steps T1, its w not
// negative. That is a screw: the way along its axis grows with time, the way around it is the chord of a longer arc.
SPS_INLINE void constant_speed_pose(const RecentMotion& motion, float* next) {
  const float *before = motion.before, *last = motion.last;
  const Quaternion<double> q0 = normalized(Quaternion<double>{before[0], before[1], before[2], before[3]});
  const Quaternion<double> q1 = normalized(Quaternion<double>{last[0], last[1], last[2], last[3]});
  const Vec3<double> t0{before[4], before[5], before[6]}, t1{last[4], last[5], last[6]};
  Quaternion<double> turn = q1 * Quaternion<double>{q0.w, -q0.x, -q0.y, -q0.z}, between = turn;
  Vec3<double> way = t1 - t0;
  if (motion.steps != 1.0F) {
    const double steps = motion.steps;
    const Vec3<double> omega = quaternion_log(turn);
    const double square = dot(omega, omega), half = 0.5 * std::sqrt(square);
    const double around = half > 1e-6 ? std::sin(steps * half) / std::sin(half) : steps;
    const double along = half > 1e-6 ? (steps - around) * dot(omega, way) / square : 0.0;
    way = around * way + along * omega;
    turn = quaternion_exp(steps * omega);
    between = quaternion_exp(0.5 * (1.0 + steps) * omega);  // from the middle of one arc to that of the other
  }
  const Quaternion<double> q = normalized(turn * q1);
  const Vec3<double> t = rotation(between) * way + t1;
  const double sign = q.w < 0.0 ? -1.0 : 1.0;
  const double pose[7] = {sign * q.w, sign * q.x, sign * q.y, sign * q.z, t.x, t.y, t.z};
  for (int i = 0; i < 7; ++i) next[i] = static_cast<float>(pose[i]);
}

}  // namespace spslam
