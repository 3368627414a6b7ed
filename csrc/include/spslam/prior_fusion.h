// The scene prior: normals of a depth image, the depth encoder, and its fusion into the sparse volume.
#pragma once

#include <cstdint>
#include <functional>

#include "core/device.h"
#include "spslam/decoders.h"
#include "spslam/types/camera.h"

namespace spslam {

constexpr int kPriorFeatures = 8;
constexpr int kEncoderInputs = 6;
constexpr int kEncoderHidden = 64;
constexpr MlpShape kEncoder{kEncoderInputs, kEncoderHidden, kPriorFeatures, MlpActivation::kNone};
constexpr std::int64_t kEncoderParameters = kEncoder.num_params();

// A depth image (m); 0, negative and not finite are invalid.
struct DepthImage {
  const float* depth;
  std::int32_t width, height;
  Intrinsics camera;
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
  bool tf32;  // on CUDA: factors of products rounded to 10 bits of mantissa
};

struct EncodedVoxels {
  std::int32_t* voxel_coords;  // [M, 3]
  float* features;             // [M, 8]
  float* weights;              // [M]
};
using AllocateEncodedVoxels = std::function<EncodedVoxels(std::int64_t count)>;

// Scratch memory on the device, kept until the call has returned.
using AllocateScratch = std::function<void*(std::int64_t bytes)>;

// Encodes points [n, 3] (m) with unit normals [n, 3]: per voxel vertex the weighted mean of the encoder's features over
// the points around it and the sum of weights, sorted by packed coordinate. `allocate` is called once, with the number
// of vertices, and says where to write; the device is waited for. Points that are not finite, out of range or without a
// normal add nothing.
template <class Device>
void encode_points(Device device, const float* points, const float* normals, std::int64_t n, const float* params,
                   const EncoderSettings& settings, const AllocateScratch& scratch,
                   const AllocateEncodedVoxels& allocate);

// A sparse volume's tensors, with room for max_voxels rows (and twice as many slots); those from num_voxels on hold 0,
// and -1 as corner ids.
struct FeatureVolume {
  std::int64_t* hash_keys;
  std::int32_t* hash_values;
  std::int64_t hash_capacity;
  std::int32_t* voxel_coords;
  std::int32_t* corner_ids;
  float* embeddings;
  float* weights;
  std::int64_t num_voxels, max_voxels;
};

struct FusionSettings {
  EncoderSettings encoder;
  std::int64_t max_points;  // the first so many with a normal are encoded
  float min_weight;         // vertices of no more weight are left out
  float kappa;              // the sum of weights that counts as one observation, the most there is
  float max_weight;         // cap of the total weight
  bool fuse_known;          // else only new vertices are filled
};

struct EncodedFrame {
  std::int64_t new_voxels;  // vertices that the volume lacked
  bool fits;                // whether there was room; else the volume is as before
  float low[3], high[3];    // bounds of all finite points; low > high where there is none
};

// Encodes a frame's points into the volume: allocates the vertices it lacks, numbered in the order of their packed
// coordinates, fuses features by equation (1) and completes the rows of corner ids. Waits for the device, once.
template <class Device>
EncodedFrame encode_frame(Device device, const FeatureVolume& volume, const float* points, const float* normals,
                          std::int64_t n, const float* params, const FusionSettings& settings,
                          const AllocateScratch& scratch);

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
