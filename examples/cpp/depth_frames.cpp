#include "depth_frames.h"

#include <algorithm>
#include <cmath>
#include <cstdint>
#include <filesystem>
#include <fstream>
#include <iterator>
#include <stdexcept>

namespace {

constexpr float kBallRadius = 0.5f, kHalfRoom = 1.6f;
constexpr float kMetersPerUnit = 0.001f;

std::vector<float> read_numbers(const std::filesystem::path& path) {
  std::ifstream file(path);
  if (!file) throw std::runtime_error(path.string() + ": cannot be read");
  return {std::istream_iterator<float>(file), std::istream_iterator<float>()};
}

// A binary PGM of 16 bits, high byte first.
DepthFrame read_depth(const std::filesystem::path& path, Intrinsics intrinsics) {
  std::ifstream file(path, std::ios::binary);
  std::string magic;
  int maximum = 0;
  file >> magic >> intrinsics.width >> intrinsics.height >> maximum;
  const bool sound = file && magic == "P5" && maximum > 255 && maximum < 65536 && intrinsics.width > 0 &&
                     intrinsics.height > 0 && intrinsics.width < 65536 && intrinsics.height < 65536;
  if (!sound) throw std::runtime_error(path.string() + ": is no PGM image of 16 bits");
  file.get();
  DepthFrame frame{intrinsics, std::vector<float>(static_cast<std::size_t>(intrinsics.width) * intrinsics.height)};
  std::vector<std::uint8_t> bytes(2 * frame.depth.size());
  if (!file.read(reinterpret_cast<char*>(bytes.data()), static_cast<std::streamsize>(bytes.size()))) {
    throw std::runtime_error(path.string() + ": ends too early");
  }
  for (std::size_t i = 0; i < frame.depth.size(); ++i) {
    frame.depth[i] = kMetersPerUnit * static_cast<float>(bytes[2 * i] << 8 | bytes[2 * i + 1]);
  }
  return frame;
}

Vector3 normalized(const Vector3& a) {
  const float s = 1 / std::sqrt(a[0] * a[0] + a[1] * a[1] + a[2] * a[2]);
  return {s * a[0], s * a[1], s * a[2]};
}

Vector3 cross(const Vector3& a, const Vector3& b) {
  return {a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]};
}

// A camera at `position` that looks at the origin, the world's z axis up.
std::array<float, 12> look_at_origin(const Vector3& position) {
  const Vector3 z = normalized({-position[0], -position[1], -position[2]});
  const Vector3 x = normalized(cross({0, 0, -1}, z));
  const Vector3 y = cross(z, x);
  return {x[0], y[0], z[0], position[0], x[1], y[1], z[1], position[1], x[2], y[2], z[2], position[2]};
}

// Depth along a ray by sphere tracing: `direction` has camera z = 1.
float trace(const Vector3& origin, const Vector3& direction) {
  const float length =
      std::sqrt(direction[0] * direction[0] + direction[1] * direction[1] + direction[2] * direction[2]);
  float t = 0;
  for (int step = 0; step < 200; ++step) {
    const float distance =
        generated_distance({origin[0] + t * direction[0], origin[1] + t * direction[1], origin[2] + t * direction[2]});
    if (distance < 1e-5f) break;
    t += distance / length;
  }
  return t;
}

}  // namespace

Vector3 DepthFrame::to_world(float u, float v, float z) const {
  const float x = (u - intrinsics.cx) / intrinsics.fx * z, y = (v - intrinsics.cy) / intrinsics.fy * z;
  Vector3 point;
  for (int i = 0; i < 3; ++i) {
    const float* row = T_world_camera.data() + 4 * i;
    point[i] = row[0] * x + row[1] * y + row[2] * z + row[3];
  }
  return point;
}

Vector3 DepthFrame::to_camera(const Vector3& point) const {
  Vector3 out{};
  for (int row = 0; row < 3; ++row) {
    const float offset = point[row] - T_world_camera[4 * row + 3];
    for (int axis = 0; axis < 3; ++axis) out[axis] += T_world_camera[4 * row + axis] * offset;
  }
  return out;
}

std::vector<DepthFrame> load_frames(const std::string& folder) {
  const std::filesystem::path root(folder);
  const std::vector<float> camera = read_numbers(root / "intrinsics.txt"), poses = read_numbers(root / "poses.txt");
  if (camera.size() != 4) throw std::runtime_error((root / "intrinsics.txt").string() + ": must contain fx fy cx cy");
  std::vector<std::filesystem::path> paths;
  for (const auto& entry : std::filesystem::directory_iterator(root / "depth")) {
    if (entry.path().extension() == ".pgm") paths.push_back(entry.path());
  }
  std::sort(paths.begin(), paths.end());
  if (paths.empty()) throw std::runtime_error((root / "depth").string() + ": holds no .pgm image");
  if (poses.size() != 16 * paths.size()) {
    throw std::runtime_error((root / "poses.txt").string() + ": must contain 16 numbers for each depth image");
  }
  std::vector<DepthFrame> frames;
  for (std::size_t i = 0; i < paths.size(); ++i) {
    frames.push_back(read_depth(paths[i], {0, 0, camera[0], camera[1], camera[2], camera[3]}));
    std::copy_n(poses.begin() + static_cast<std::ptrdiff_t>(16 * i), 12, frames.back().T_world_camera.begin());
  }
  return frames;
}

std::vector<DepthFrame> generate_frames(int count) {
  const Intrinsics intrinsics{160, 120, 120.0f, 120.0f, 79.5f, 59.5f};
  std::vector<DepthFrame> frames;
  for (int i = 0; i < count; ++i) {
    const float angle = 6.2831853f * static_cast<float>(i) / static_cast<float>(count);
    const Vector3 position{1.3f * std::cos(angle), 1.3f * std::sin(angle), 0.6f};
    DepthFrame frame{intrinsics, {}, look_at_origin(position)};
    for (int v = 0; v < intrinsics.height; ++v) {
      for (int u = 0; u < intrinsics.width; ++u) {
        const Vector3 ahead = frame.to_world(static_cast<float>(u), static_cast<float>(v), 1.0f);
        frame.depth.push_back(
            trace(position, {ahead[0] - position[0], ahead[1] - position[1], ahead[2] - position[2]}));
      }
    }
    frames.push_back(std::move(frame));
  }
  return frames;
}

float generated_distance(const Vector3& point) {
  const float ball = std::sqrt(point[0] * point[0] + point[1] * point[1] + point[2] * point[2]) - kBallRadius;
  float walls = kHalfRoom;
  for (float c : point) walls = std::min(walls, kHalfRoom - std::fabs(c));
  return std::min(ball, walls);
}
