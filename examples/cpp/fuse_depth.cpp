// Fuses depth images with known poses into a mesh, with spslam's CPU kernels and without torch.
//
//   fuse_depth FOLDER mesh.ply        depth/*.pgm, intrinsics.txt, poses.txt (see depth_frames.h)
//   fuse_depth --generated mesh.ply   a ball in a box; fails unless the mesh lies on it

#include <cmath>
#include <cstdio>
#include <exception>
#include <stdexcept>
#include <string>

#include "depth_frames.h"
#include "mesh.h"
#include "tsdf_volume.h"

namespace {

constexpr float kVoxelSize = 0.03f, kTruncation = 0.09f;  // m
constexpr int kGeneratedFrames = 24;
// Nearest pixels are up to 14 mm apart on the walls; averaging views leaves about 2 mm of it.
constexpr double kMeanDistanceLimit = kVoxelSize / 6;

Mesh fuse(const std::vector<DepthFrame>& frames) {
  TsdfVolume volume(kVoxelSize, kTruncation);
  for (const DepthFrame& frame : frames) volume.integrate(frame);
  Mesh mesh = volume.extract_mesh();
  std::printf("%zu frames, %lld voxels, %zu vertices, %zu faces\n", frames.size(),
              static_cast<long long>(volume.num_voxels()), mesh.vertices.size() / 3, mesh.faces.size() / 3);
  return mesh;
}

void check_against_generated(const Mesh& mesh) {
  if (mesh.faces.empty()) throw std::runtime_error("the mesh is empty");
  double sum = 0;
  for (std::size_t i = 0; i < mesh.vertices.size(); i += 3) {
    sum += std::fabs(generated_distance({mesh.vertices[i], mesh.vertices[i + 1], mesh.vertices[i + 2]}));
  }
  const double mean = sum / static_cast<double>(mesh.vertices.size() / 3);
  std::printf("mean distance to the true surface: %.2f mm\n", 1e3 * mean);
  if (!(mean < kMeanDistanceLimit)) throw std::runtime_error("the mesh is off the true surface");
}

}  // namespace

int main(int argc, char** argv) {
  if (argc != 3) {
    std::fprintf(stderr, "usage: fuse_depth FOLDER|--generated mesh.ply\n");
    return 2;
  }
  try {
    const bool generated = std::string(argv[1]) == "--generated";
    const Mesh mesh = fuse(generated ? generate_frames(kGeneratedFrames) : load_frames(argv[1]));
    if (generated) check_against_generated(mesh);
    write_ply(mesh, argv[2]);
  } catch (const std::exception& error) {
    std::fprintf(stderr, "fuse_depth: %s\n", error.what());
    return 1;
  }
}
