#include "spslam/rasterization.h"

#include <algorithm>
#include <cmath>

namespace spslam {
namespace {

struct Corner {
  double x, y, z;
};

struct Triangle {
  Corner corners[3];
};

// The pixel centers between two coordinates along an axis of an image, none where first > last.
struct PixelRange {
  std::int32_t first, last;
};

PixelRange pixel_range(double a, double b, double c, std::int32_t size) {
  const double first = std::ceil(std::min({a, b, c})), last = std::floor(std::max({a, b, c}));
  return {static_cast<std::int32_t>(std::clamp(first, 0.0, static_cast<double>(size))),
          static_cast<std::int32_t>(std::clamp(last, -1.0, static_cast<double>(size - 1)))};
}

// A function that is linear in the image, of the offset (px) from a pixel: in float32, as of a pixel's faces the
// visible one is found by comparing them.
struct Plane {
  float constant, by_x, by_y;

  float at(float x, float y) const { return constant + by_x * x + by_y * y; }
};

class Rasterizer {
 public:
  Rasterizer(const PinholeView& view, double nearest, bool cull_back, float* depth, std::int32_t* face_ids)
      : view_(view), nearest_(nearest), cull_back_(cull_back), inverse_depth_(depth), face_ids_(face_ids) {
    std::fill_n(inverse_depth_, num_pixels(), 0.0f);
    std::fill_n(face_ids_, num_pixels(), -1);
  }

  // A face, clipped where it comes too near.
  void add(const Triangle& face, std::int32_t id) {
    const Corner* at = face.corners;
    if (is_outside(face)) return;
    int num_behind = 0, behind = 0, before = 0;
    for (int k = 0; k < 3; ++k) {
      const bool is_behind = at[k].z < nearest_;
      num_behind += is_behind;
      (is_behind ? behind : before) = k;
    }
    if (num_behind == 0) return draw(face, id);
    if (num_behind == 3) return;
    // The corner alone on its side comes first, which keeps the orientation.
    const int alone = num_behind == 1 ? behind : before;
    const Corner &first = at[alone], &second = at[(alone + 1) % 3], &third = at[(alone + 2) % 3];
    if (num_behind == 2) return draw({first, clipped(second, first), clipped(third, first)}, id);
    const Corner left = clipped(first, second), right = clipped(first, third);
    draw({left, second, third}, id);
    draw({left, third, right}, id);
  }

  // After the last face: depth in place of its inverse.
  void finish() {
    for (std::int64_t i = 0; i < num_pixels(); ++i) {
      if (inverse_depth_[i] > 0.0f) inverse_depth_[i] = 1.0f / inverse_depth_[i];
    }
  }

 private:
  std::int64_t num_pixels() const { return static_cast<std::int64_t>(view_.width) * view_.height; }

  // Whether all corners are beyond one side of the image.
  bool is_outside(const Triangle& face) const {
    int sides = 15;
    for (const Corner& at : face.corners) {
      const double x = at.x * view_.fx + (view_.cx + 0.5) * at.z, y = at.y * view_.fy + (view_.cy + 0.5) * at.z;
      sides &= (x < 0) | (x > view_.width * at.z) << 1 | (y < 0) << 2 | (y > view_.height * at.z) << 3;
    }
    return sides != 0;
  }

  // Where the edge from a corner behind the nearest depth to one before it crosses that.
  Corner clipped(const Corner& behind, const Corner& before) const {
    const double share = (nearest_ - behind.z) / (before.z - behind.z);
    return {behind.x + share * (before.x - behind.x), behind.y + share * (before.y - behind.y),
            behind.z + share * (before.z - behind.z)};
  }

  void draw(const Triangle& triangle, std::int32_t id) {
    double u[3], v[3], inverse_z[3];
    for (int k = 0; k < 3; ++k) {
      const Corner& at = triangle.corners[k];
      inverse_z[k] = 1 / at.z;
      u[k] = at.x * inverse_z[k] * view_.fx + view_.cx;
      v[k] = at.y * inverse_z[k] * view_.fy + view_.cy;
    }
    const double du1 = u[1] - u[0], dv1 = v[1] - v[0], du2 = u[2] - u[0], dv2 = v[2] - v[0];
    const double area = du1 * dv2 - du2 * dv1;
    // Counter-clockwise in a world with y up is clockwise in an image with v down.
    if (!std::isfinite(area) || area == 0 || (cull_back_ && area > 0)) return;
    const PixelRange columns = pixel_range(u[0], u[1], u[2], view_.width);
    const PixelRange rows = pixel_range(v[0], v[1], v[2], view_.height);
    if (columns.first > columns.last || rows.first > rows.last) return;
    // Two barycentric coordinates and the inverse depth, as offsets from the box's first pixel.
    const double x = columns.first - u[0], y = rows.first - v[0], scale = 1 / area;
    const double b1 = dv2 * scale, c1 = -du2 * scale, b2 = -dv1 * scale, c2 = du1 * scale;
    const double a1 = b1 * x + c1 * y, a2 = b2 * x + c2 * y;
    const double dz1 = inverse_z[1] - inverse_z[0], dz2 = inverse_z[2] - inverse_z[0];
    const Plane first = plane(a1, b1, c1), second = plane(a2, b2, c2);
    const Plane inverse = plane(inverse_z[0] + a1 * dz1 + a2 * dz2, b1 * dz1 + b2 * dz2, c1 * dz1 + c2 * dz2);
    const float largest = static_cast<float>(1 / nearest_);
    for (std::int32_t row = rows.first; row <= rows.last; ++row) {
      const std::int64_t line = static_cast<std::int64_t>(row) * view_.width;
      const float offset_y = static_cast<float>(row - rows.first);
      for (std::int32_t column = columns.first; column <= columns.last; ++column) {
        const float offset_x = static_cast<float>(column - columns.first);
        const float one = first.at(offset_x, offset_y), two = second.at(offset_x, offset_y);
        if (!(one >= 0 && two >= 0 && one + two <= 1)) continue;
        // Rounding can give the edge of a thin triangle that is seen edge-on any inverse depth.
        const float nearness = std::clamp(inverse.at(offset_x, offset_y), 1e-6f, largest);
        const std::int64_t pixel = line + column;
        if (nearness > inverse_depth_[pixel] || (nearness == inverse_depth_[pixel] && id > face_ids_[pixel])) {
          inverse_depth_[pixel] = nearness;
          face_ids_[pixel] = id;
        }
      }
    }
  }

  static Plane plane(double constant, double by_x, double by_y) {
    return {static_cast<float>(constant), static_cast<float>(by_x), static_cast<float>(by_y)};
  }

  PinholeView view_;
  double nearest_;
  bool cull_back_;
  float* inverse_depth_;
  std::int32_t* face_ids_;
};

}  // namespace

void rasterize(Cpu, const CameraMesh& mesh, const PinholeView& view, double nearest, bool cull_back, float* depth,
               std::int32_t* face_ids) {
  Rasterizer rasterizer(view, nearest, cull_back, depth, face_ids);
  for (std::int64_t face = 0; face < mesh.num_faces; ++face) {
    Triangle triangle;
    for (int k = 0; k < 3; ++k) {
      const double* at = mesh.points + 3 * static_cast<std::int64_t>(mesh.faces[3 * face + k]);
      triangle.corners[k] = {at[0], at[1], at[2]};
    }
    rasterizer.add(triangle, static_cast<std::int32_t>(face));
  }
  rasterizer.finish();
}

}  // namespace spslam
