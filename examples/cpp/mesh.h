// A triangle mesh and its file.
#pragma once

#include <cstdint>
#include <string>
#include <vector>

struct Mesh {
  std::vector<float> vertices;      // [K, 3] m
  std::vector<std::int64_t> faces;  // [L, 3] counter-clockwise seen from free space
};

// Writes binary PLY. Throws std::runtime_error where the file cannot be written.
void write_ply(const Mesh& mesh, const std::string& path);
