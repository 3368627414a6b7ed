// Depth images with known poses: from a folder, or of a generated scene whose surface is known.
#pragma once

#include <array>
#include <string>
#include <vector>

struct Intrinsics {
  int width, height;
  float fx, fy, cx, cy;  // px
};

using Vector3 = std::array<float, 3>;

struct DepthFrame {
  Intrinsics intrinsics;
  std::vector<float> depth;                // [height, width] m along the optical axis, 0 = not measured
  std::array<float, 12> T_world_camera{};  // 3x4, row-major; camera axes x right, y down, z forward

  Vector3 to_world(float u, float v, float z) const;
  Vector3 to_camera(const Vector3& point) const;
};

// FOLDER/depth/*.pgm (16 bits, millimeters), FOLDER/intrinsics.txt (fx fy cx cy) and FOLDER/poses.txt (16 numbers a
// frame, the 4x4 matrix from camera to world). Throws std::runtime_error, naming the file.
std::vector<DepthFrame> load_frames(const std::string& folder);

// A ball in a box, seen from a camera on a circle around it.
std::vector<DepthFrame> generate_frames(int count);

// Signed distance (m) to the surface of that scene, positive in free space.
float generated_distance(const Vector3& point);
