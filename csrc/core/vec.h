// Small vectors, rotations and quaternions (w, x, y, z), for both devices.
#pragma once

#include <cmath>

#include "core/macros.h"

namespace spslam {

template <class T>
struct Vec3 {
  T x, y, z;
};

template <class T>
SPS_INLINE Vec3<T> operator+(const Vec3<T>& a, const Vec3<T>& b) {
  return {a.x + b.x, a.y + b.y, a.z + b.z};
}
template <class T>
SPS_INLINE Vec3<T> operator-(const Vec3<T>& a, const Vec3<T>& b) {
  return {a.x - b.x, a.y - b.y, a.z - b.z};
}
template <class T>
SPS_INLINE Vec3<T> operator*(T s, const Vec3<T>& a) {
  return {s * a.x, s * a.y, s * a.z};
}
template <class T>
SPS_INLINE T dot(const Vec3<T>& a, const Vec3<T>& b) {
  return a.x * b.x + a.y * b.y + a.z * b.z;
}
template <class T>
SPS_INLINE Vec3<T> cross(const Vec3<T>& a, const Vec3<T>& b) {
  return {a.y * b.z - a.z * b.y, a.z * b.x - a.x * b.z, a.x * b.y - a.y * b.x};
}

template <class T>
struct Mat3 {
  T m[9];  // row-major
};

template <class T>
SPS_INLINE Vec3<T> operator*(const Mat3<T>& a, const Vec3<T>& v) {
  return {a.m[0] * v.x + a.m[1] * v.y + a.m[2] * v.z, a.m[3] * v.x + a.m[4] * v.y + a.m[5] * v.z,
          a.m[6] * v.x + a.m[7] * v.y + a.m[8] * v.z};
}

template <class T>
struct Quaternion {
  T w, x, y, z;
};

template <class T>
SPS_INLINE Quaternion<T> operator*(const Quaternion<T>& a, const Quaternion<T>& b) {
  return {a.w * b.w - a.x * b.x - a.y * b.y - a.z * b.z, a.w * b.x + a.x * b.w + a.y * b.z - a.z * b.y,
          a.w * b.y - a.x * b.z + a.y * b.w + a.z * b.x, a.w * b.z + a.x * b.y - a.y * b.x + a.z * b.w};
}

template <class T>
SPS_INLINE Quaternion<T> normalized(const Quaternion<T>& q) {
  const T s = T(1) / std::sqrt(q.w * q.w + q.x * q.x + q.y * q.y + q.z * q.z);
  return {q.w * s, q.x * s, q.y * s, q.z * s};
}

// Rotation matrix of a unit quaternion.
template <class T>
SPS_INLINE Mat3<T> rotation(const Quaternion<T>& q) {
  return {{1 - 2 * (q.y * q.y + q.z * q.z), 2 * (q.x * q.y - q.w * q.z), 2 * (q.x * q.z + q.w * q.y),
           2 * (q.x * q.y + q.w * q.z), 1 - 2 * (q.x * q.x + q.z * q.z), 2 * (q.y * q.z - q.w * q.x),
           2 * (q.x * q.z - q.w * q.y), 2 * (q.y * q.z + q.w * q.x), 1 - 2 * (q.x * q.x + q.y * q.y)}};
}

// Unit quaternion of a rotation vector (axis times angle, rad).
template <class T>
SPS_INLINE Quaternion<T> quaternion_exp(const Vec3<T>& omega) {
  const T angle = std::sqrt(dot(omega, omega));
  const T half = T(0.5) * angle;
  const T s = angle > T(1e-6) ? std::sin(half) / angle : T(0.5) - angle * angle / T(48);
  return {std::cos(half), s * omega.x, s * omega.y, s * omega.z};
}

// Rotation vector of a unit quaternion, the shorter way.
template <class T>
SPS_INLINE Vec3<T> quaternion_log(const Quaternion<T>& q) {
  const T sign = q.w < T(0) ? T(-1) : T(1), sine = std::sqrt(q.x * q.x + q.y * q.y + q.z * q.z);
  const T s = sine > T(1e-6) ? T(2) * std::atan2(sine, sign * q.w) / sine : T(2);
  return {sign * s * q.x, sign * s * q.y, sign * s * q.z};
}

// A camera pose T_world_camera.
template <class T>
struct Pose {
  Mat3<T> rotation;
  Vec3<T> translation;
};

// From seven numbers: quaternion (w, x, y, z), not necessarily unit, and translation.
template <class T>
SPS_INLINE Pose<T> load_pose(const T* p) {
  return {rotation(normalized(Quaternion<T>{p[0], p[1], p[2], p[3]})), {p[4], p[5], p[6]}};
}

}  // namespace spslam
