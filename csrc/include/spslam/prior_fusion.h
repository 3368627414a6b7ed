// The scene prior: normals of a depth image, the depth encoder, and its fusion into the sparse volume.
#pragma once

#include <cstdint>
#include <functional>

#include "core/device.h"

namespace spslam {

constexpr int kPriorFeatures = 8;
constexpr int kEncoderInputs = 6;
constexpr int kEncoderHidden = 64;
// W1 [64, 6], b1, W2 [64, 64], b2, W3 [8, 64], b3; row-major, in this order.
constexpr std::int64_t kEncoderParameters = kEncoderHidden * (kEncoderInputs + 1) +
                                            kEncoderHidden * (kEncoderHidden + 1) +
                                            kPriorFeatures * (kEncoderHidden + 1);

// A pinhole camera, px.
struct DepthCamera {
  float fx, fy, cx, cy;
};

// A depth image (m); 0, negative and not finite are invalid.
struct DepthImage {
  const float* depth;
  std::int32_t width, height;
  DepthCamera camera;
};

// Unit normals in camera axes, turned to the camera, of pixels (u, v); 0 where the surface is not smooth around one.
template <class Device>
void depth_normals(Device device, const DepthImage& image, const std::int32_t* pixels, std::int64_t n,
                   std::int32_t step_px, float max_jump, float* normals);

// How points spread over voxel vertices: the 64 vertices within two voxels along each axis, or the 8 of their cell.
struct EncoderSettings {
  float voxel_size;
  std::int32_t neighborhood;
  float min_pair_weight;
};

struct EncodedVoxels {
  std::int32_t* voxel_coords;  // [M, 3]
  float* features;             // [M, 8]
  float* weights;              // [M]
};
using AllocateEncodedVoxels = std::function<EncodedVoxels(std::int64_t count)>;

// Scratch bytes that encode_points needs for n points.
template <class Device>
std::int64_t encode_points_workspace_bytes(Device device, std::int64_t n, std::int32_t neighborhood);

// Encodes points [n, 3] (m) with unit normals [n, 3]: per voxel vertex the weighted mean of the encoder's features over
// the points around it and the sum of weights, sorted by packed coordinate. `allocate` is called once, with the number
// of vertices, and says where to write. Points that are not finite, out of range or without a normal add nothing.
template <class Device>
void encode_points(Device device, const float* points, const float* normals, std::int64_t n, const float* params,
                   const EncoderSettings& settings, void* workspace, const AllocateEncodedVoxels& allocate);

// Equation (1) of SP-SLAM on rows voxel_ids of an [V, 8] volume: weighted mean of what is there and what is new, the
// total weight capped. Rows outside [0, V) are skipped; the ids are distinct.
template <class Device>
void fuse_prior(Device device, const std::int32_t* voxel_ids, const float* features, const float* feature_weights,
                std::int64_t count, std::int64_t num_voxels, float max_weight, float* embeddings, float* weights);

// Normally distributed starts of embeddings [n, 8] that depend on the voxel's coordinates and the seed alone.
template <class Device>
void random_embeddings(Device device, const std::int32_t* voxel_coords, std::int64_t n, std::int64_t seed, float scale,
                       float* embeddings);

}  // namespace spslam
