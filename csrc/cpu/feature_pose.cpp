#include "spslam/feature_pose.h"

#include <algorithm>
#include <cmath>

#include "kernels/color_pose.h"
#include "kernels/feature_pose.h"

namespace spslam {
namespace {

constexpr int kHoldIterations = 6;   // at most; none after one that moved the pose by less than kSmallStep
constexpr double kSmallStep = 1e-5;  // m and rad, a hundredth of what either matters
constexpr double kSolvable = 1e-12;  // share of a diagonal entry that elimination must leave

using Point = Vec3<double>;

Point load_point(const double* p) {
  return {p[0], p[1], p[2]};
}

Point to_camera(const Mat3<double>& rotation, const Point& v) {
  const double* r = rotation.m;
  return {r[0] * v.x + r[3] * v.y + r[6] * v.z, r[1] * v.x + r[4] * v.y + r[7] * v.z,
          r[2] * v.x + r[5] * v.y + r[8] * v.z};
}

Pose<double> pose_of(const double* m) {
  return {{{m[0], m[1], m[2], m[4], m[5], m[6], m[8], m[9], m[10]}}, {m[3], m[7], m[11]}};
}

// Calls f(i, shown) for each point before the camera.
template <class F>
void for_each_point(const SeenPoints& seen, const FeatureCamera& k, const Pose<double>& pose, const F& f) {
  for (std::int64_t i = 0; i < seen.count; ++i) {
    const Point point = to_camera(pose.rotation, load_point(seen.points + 3 * i) - pose.translation);
    if (!(point.z > kMinFeatureDepth)) continue;
    const Point moved = kDepthDeviations * to_camera(pose.rotation, load_point(seen.deviations + 3 * i));
    f(i, shown_feature(k, point, 1.0 / point.z, seen.positions + 2 * i, moved));
  }
}

// And of each ray at its expected inverse depth, by which its point is scaled.
template <class F>
void for_each_ray(const SeenRays& seen, const FeatureCamera& k, const Pose<double>& pose, const F& f) {
  const Point moved = to_camera(pose.rotation, load_point(seen.origin) - pose.translation);
  for (std::int64_t i = 0; i < seen.count; ++i) {
    const double inverse_depth = 0.5 / seen.beyond[i];
    const Point point = to_camera(pose.rotation, load_point(seen.directions + 3 * i)) + inverse_depth * moved;
    if (!(point.z > kMinFeatureDepth)) continue;
    const Point off = kInverseDepthDeviations * inverse_depth * moved;
    f(i, shown_feature(k, point, inverse_depth / point.z, seen.positions + 2 * i, off));
  }
}

// Sums over features, in camera axes.
struct FeatureSums {
  FeatureCamera camera;
  double error_px;
  std::int64_t agreeing = 0;
  double terms[kNormalTerms] = {};

  void add(const ShownFeature& shown) {
    const FeatureError error = feature_error(camera, shown, error_px);
    agreeing += error.square() < error_px * error_px;
    add_feature(camera, shown, error, error_px, terms);
  }

  // In world axes; features weigh as `kIndependentFeatures` where more agree, or should.
  FeatureEquations equations(const Mat3<double>& rotation, std::int64_t least) const {
    const double agree = static_cast<double>(std::max<std::int64_t>({agreeing, least, 1}));
    const double share = std::min(1.0, kIndependentFeatures / agree) / (error_px * error_px);
    double hessian[36], gradient[6], cost;
    store_normal_terms(terms, hessian, gradient, &cost);
    FeatureEquations found{agreeing, {}, {}};
    const double* r = rotation.m;
    for (int a = 0; a < 6; ++a) {
      const int block_a = a / 3 * 3, row = 3 * (a % 3);
      for (int i = 0; i < 3; ++i) found.gradient[a] += share * r[row + i] * gradient[block_a + i];
      for (int b = 0; b < 6; ++b) {
        const int block_b = b / 3 * 3, column = 3 * (b % 3);
        double sum = 0.0;
        for (int i = 0; i < 3; ++i) {
          for (int j = 0; j < 3; ++j) sum += r[row + i] * hessian[6 * (block_a + i) + block_b + j] * r[column + j];
        }
        found.hessian[6 * a + b] = share * sum;
      }
    }
    return found;
  }
};

FeatureEquations equations_of(const SeenPoints& seen, const FeatureCamera& camera, const Pose<double>& pose,
                              double error_px) {
  FeatureSums sums{camera, error_px};
  for_each_point(seen, camera, pose, [&](std::int64_t, const ShownFeature& shown) { sums.add(shown); });
  return sums.equations(pose.rotation, 0);
}

FeatureEquations equations_of(const SeenRays& seen, const FeatureCamera& camera, const Pose<double>& pose,
                              double error_px, std::int64_t least) {
  FeatureSums sums{camera, error_px};
  for_each_ray(seen, camera, pose, [&](std::int64_t, const ShownFeature& shown) { sums.add(shown); });
  return sums.equations(pose.rotation, least);
}

// A pose whose rotation is a quaternion, which turns by products.
struct TurnedPose {
  Quaternion<double> turn;
  Point center;

  static TurnedPose of(const double* p) {
    return {normalized(Quaternion<double>{p[0], p[1], p[2], p[3]}), load_point(p + 4)};
  }
  Pose<double> pose() const { return {rotation(turn), center}; }
  // From another pose to this one.
  Point turn_since(const TurnedPose& other) const {
    const Quaternion<double>& q = other.turn;
    return quaternion_log(turn * Quaternion<double>{q.w, -q.x, -q.y, -q.z});
  }
};

// Of the color image of a frame at a pose, and how much it moves with a step of that.
struct MovedPose {
  Pose<double> pose;
  double lever;
};

MovedPose color_pose(const FeatureMotion& motion, const TurnedPose& at) {
  if (!motion.before) return {at.pose(), 1.0};
  const TurnedPose before = TurnedPose::of(motion.before);
  const Point turn = at.turn_since(before), way = at.center - before.center;
  const double on_top = std::fabs(motion.share), share = 1.0 + motion.share;
  if (on_top * std::sqrt(dot(turn, turn)) > kMaxColorTurn || on_top * std::sqrt(dot(way, way)) > kMaxColorTranslation) {
    return {at.pose(), 1.0};
  }
  return {{rotation(quaternion_exp(share * turn) * before.turn), before.center + share * way}, share};
}

}  // namespace

FeatureEquations point_equations(Cpu, const SeenPoints& seen, const FeatureCamera& camera, const double* pose,
                                 double error_px) {
  return equations_of(seen, camera, pose_of(pose), error_px);
}

void agreeing_points(Cpu, const SeenPoints& seen, const FeatureCamera& camera, const double* pose, double error_px,
                     bool* agrees) {
  std::fill(agrees, agrees + seen.count, false);
  for_each_point(seen, camera, pose_of(pose), [&](std::int64_t i, const ShownFeature& shown) {
    agrees[i] = feature_error(camera, shown, error_px).square() < error_px * error_px;
  });
}

FeatureEquations ray_equations(Cpu, const SeenRays& seen, const FeatureCamera& camera, const double* pose,
                               double error_px, std::int64_t least) {
  return equations_of(seen, camera, pose_of(pose), error_px, least);
}

std::int64_t hold_pose(Cpu, const SeenPoints& points, const SeenRays* rays, std::int64_t groups,
                       const FeatureCamera& camera, const FeatureMotion& motion, const double* pose,
                       const double* information, const HoldOptions& options, double* held) {
  const TurnedPose start = TurnedPose::of(pose);
  TurnedPose at = start;
  std::int64_t agreeing = 0;
  for (int iteration = 0; iteration < kHoldIterations; ++iteration) {
    const MovedPose color = color_pose(motion, at);
    FeatureEquations features = equations_of(points, camera, color.pose, options.error_px);
    agreeing = features.agreeing;
    if (agreeing < options.least) return -1;
    for (std::int64_t group = 0; group < groups; ++group) {
      const FeatureEquations by_rays = equations_of(rays[group], camera, color.pose, options.error_px, agreeing);
      for (int i = 0; i < 36; ++i) features.hessian[i] += by_rays.hessian[i];
      for (int i = 0; i < 6; ++i) features.gradient[i] += by_rays.gradient[i];
    }
    const Point way = at.center - start.center, turn = at.turn_since(start);
    const double change[6] = {way.x, way.y, way.z, turn.x, turn.y, turn.z};
    double hessian[36], gradient[6], step[6];
    for (int a = 0; a < 6; ++a) {
      gradient[a] = color.lever * features.gradient[a];
      for (int b = 0; b < 6; ++b) {
        const int i = 6 * a + b;
        hessian[i] = information[i] + color.lever * color.lever * features.hessian[i];
        gradient[a] += information[i] * change[b];
      }
    }
    solve_damped_6x6<double>(hessian, gradient, 0.0, 1.0, kSolvable, step);
    at.center = at.center + load_point(step);
    at.turn = normalized(quaternion_exp(load_point(step + 3)) * at.turn);
    const auto smaller = [](double a, double b) { return std::fabs(a) < std::fabs(b); };
    if (std::fabs(*std::max_element(step, step + 6, smaller)) < kSmallStep) break;
  }
  const double sign = at.turn.w < 0.0 ? -1.0 : 1.0;
  const double found[7] = {sign * at.turn.w, sign * at.turn.x, sign * at.turn.y, sign * at.turn.z,
                           at.center.x,      at.center.y,      at.center.z};
  std::copy(found, found + 7, held);
  return agreeing;
}

}  // namespace spslam
