#include "spslam/mesh_shading.h"

#include <algorithm>
#include <cmath>

#include "core/vec.h"

namespace spslam {
namespace {

constexpr float kLeastArea = 1e-30f, kLeastSum = 1e-12f, kLeastLength = 1e-6f;

struct Corners {
  Vec3<float> a, b, c;
};

Corners corners_of(const CameraMesh& mesh, std::int32_t face) {
  Vec3<float> at[3];
  for (int k = 0; k < 3; ++k) {
    const double* point =
        mesh.points + 3 * static_cast<std::int64_t>(mesh.faces[3 * static_cast<std::int64_t>(face) + k]);
    at[k] = {static_cast<float>(point[0]), static_cast<float>(point[1]), static_cast<float>(point[2])};
  }
  return {at[0], at[1], at[2]};
}

// The share of a triangle's second and third corner in a point of its plane, and of the first; they sum to 1.
Vec3<float> corner_shares(const Corners& at, const Vec3<float>& point, const Vec3<float>& normal) {
  const float area = std::max(dot(normal, normal), kLeastArea);
  const float second = dot(cross(point - at.a, at.c - at.a), normal) / area;
  const float third = dot(cross(at.b - at.a, point - at.a), normal) / area;
  const Vec3<float> inside{std::clamp(1.0f - second - third, 0.0f, 1.0f), std::clamp(second, 0.0f, 1.0f),
                           std::clamp(third, 0.0f, 1.0f)};
  return (1.0f / std::max(inside.x + inside.y + inside.z, kLeastSum)) * inside;
}

void write(const Vec3<float>& value, float* out) {
  out[0] = value.x, out[1] = value.y, out[2] = value.z;
}

}  // namespace

void rastered_surface(Cpu, const CameraMesh& mesh, const std::uint8_t* colors, const PinholeView& view,
                      const RasterView& raster, float* normals, float* pixel_colors) {
  std::int64_t pixel = 0;
  for (std::int32_t row = 0; row < view.height; ++row) {
    const float y = static_cast<float>((row - view.cy) / view.fy);
    for (std::int32_t column = 0; column < view.width; ++column, ++pixel) {
      float *normal_out = normals + 3 * pixel, *color_out = pixel_colors + 3 * pixel;
      const std::int32_t face = raster.face_ids[pixel];
      if (face < 0) {
        write({0, 0, 0}, normal_out);
        write({0, 0, 0}, color_out);
        continue;
      }
      const Vec3<float> ray{static_cast<float>((column - view.cx) / view.fx), y, 1.0f};
      const Vec3<float> point = raster.depth[pixel] * ray;
      const Corners at = corners_of(mesh, face);
      const Vec3<float> normal = cross(at.b - at.a, at.c - at.a);
      const float length = std::sqrt(dot(normal, normal)), toward = dot(normal, point) > 0 ? -1.0f : 1.0f;
      write(length > 0 ? (toward / length) * normal : Vec3<float>{0, 0, 0}, normal_out);
      const Vec3<float> shares = corner_shares(at, point, normal);
      const std::int32_t* corners = mesh.faces + 3 * static_cast<std::int64_t>(face);
      const std::uint8_t *a = colors + 3 * static_cast<std::int64_t>(corners[0]),
                         *b = colors + 3 * static_cast<std::int64_t>(corners[1]),
                         *c = colors + 3 * static_cast<std::int64_t>(corners[2]);
      for (int k = 0; k < 3; ++k) color_out[k] = shares.x * a[k] + shares.y * b[k] + shares.z * c[k];
    }
  }
}

void light_pixels(Cpu, const MeshLight& light, std::int64_t count, const std::int32_t* face_ids, const float* normals,
                  const float* pixel_colors, std::uint8_t background, std::uint8_t* image) {
  const Vec3<float> direction{light.direction[0], light.direction[1], light.direction[2]};
  for (std::int64_t pixel = 0; pixel < count; ++pixel) {
    std::uint8_t* out = image + 3 * pixel;
    if (face_ids[pixel] < 0) {
      out[0] = out[1] = out[2] = background;
      continue;
    }
    const Vec3<float> normal{normals[3 * pixel], normals[3 * pixel + 1], normals[3 * pixel + 2]};
    const float length = std::max(std::sqrt(dot(normal, normal)), kLeastLength);
    const float facing = std::clamp(dot(normal, direction) / length, 0.0f, 1.0f);
    const float brightness = light.ambient + light.diffuse * facing;
    for (int k = 0; k < 3; ++k) {
      out[k] = static_cast<std::uint8_t>(std::clamp(brightness * pixel_colors[3 * pixel + k], 0.0f, 255.0f));
    }
  }
}

}  // namespace spslam
