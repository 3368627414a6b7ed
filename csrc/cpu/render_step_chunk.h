// The working memory of render_step for a chunk of rays, the unit of work of one thread.
#pragma once

#include <cstdint>

#include "cpu/mlp_tile.h"
#include "kernels/pixel_record.h"
#include "kernels/ray_pose_gradient.h"
#include "kernels/ray_sampling.h"
#include "kernels/volume_rendering.h"
#include "spslam/render_step.h"

namespace spslam::render {

constexpr std::int64_t kChunkRays = 32;
constexpr std::int64_t kFeatureBytes = kEmbeddingChannels * sizeof(float);
using Feature = Vector<float, static_cast<int>(kFeatureBytes)>;
// Value and three derivatives of an interpolated feature.
constexpr std::int64_t kGeometrySlopes = 3 * kEmbeddingChannels, kColorSlopes = 3 * kPlaneChannels;

struct Ray {
  Vec3<float> origin, direction;  // world; the direction has camera z = 1
  Pixel pixel;
  float cosine;  // from distance along the ray to distance to the surface
  bool valid;    // has a depth
  std::int32_t frame;
  std::int32_t begin, end;  // its samples inside the volume
  std::int32_t color_begin, color_end;
  std::int32_t num_free, num_near;
  float inverse_bell_sum;  // 0 where nothing is rendered
  float rendered_depth, rendered_color[3];
  RayLosses<float> losses;
};

// What a call has to compute besides the losses.
struct Plan {
  bool color;  // the color term has a weight
  bool pose;   // gradients to sample positions
  bool embeddings, texels;
  bool geometry_params, color_params;

  bool geometry_backward() const { return pose || embeddings || geometry_params; }
  bool color_backward() const { return color && (pose || texels || color_params); }
};

// A cell that samples of a chunk lie in.
struct ChunkCell {
  std::int64_t key;
  std::int64_t slot;      // in the hash table
  std::int32_t voxel_id;  // its lowest corner; kNoVoxel where the cell is incomplete
};

// Where a sample lies in one plane's cell.
struct PlaneFraction {
  float u, v;
};

// Parts of the embeddings that are filled independently: blocks of 64 rows (neighboring vertices have neighboring ids),
// assigned in turn.
constexpr int kEmbeddingParts = 4, kEmbeddingBlockShift = 6;

static_assert(kEmbeddingParts * kCellCorners <= 32, "one bit for each corner in each part");

// Consecutive samples in one cell: those from the end of the run before to `end`.
struct EmbeddingRun {
  std::int32_t corners[kCellCorners];
  std::uint8_t owned[kEmbeddingParts];  // bit k: corner k is in this part
  std::int32_t end;
};
struct TexelRun {
  std::int32_t row, end;
};

// Per-thread memory, kept from call to call. Arrays hold kChunkRays * num_samples rows.
class Chunk {
 public:
  void reserve(std::int32_t num_samples, const MlpLayout<float>& geometry, const MlpLayout<float>& color) {
    const std::int64_t n = kChunkRays * num_samples;
    samples_per_ray = num_samples;
    depth_scratch = depth_scratch_.reserve(4 * num_samples + 2 * kDrawLanes);
    depths = depths_.reserve(n);
    keys = keys_.reserve(num_samples);
    cell_of = cell_of_.reserve(n);
    cells = cells_.reserve(n);
    t = t_.reserve(n);
    voxel_of = voxel_of_.reserve(n);
    ray_of = ray_of_.reserve(n);
    local = local_.reserve(n);
    x = x_.reserve(n * geometry.input_stride);
    h1 = h1_.reserve(n * geometry.hidden_stride);
    h2 = h2_.reserve(n * geometry.hidden_stride);
    slopes = slopes_.reserve(n * kGeometrySlopes);
    sdf = sdf_.reserve(n);
    bells = bells_.reserve(n);
    bell_slopes = bell_slopes_.reserve(n);
    weights = weights_.reserve(n);
    grad_sdf = grad_sdf_.reserve(n);
    color_sample = color_sample_.reserve(n);
    color_x = color_x_.reserve(n * color.input_stride);
    color_h1 = color_h1_.reserve(n * color.hidden_stride);
    color_h2 = color_h2_.reserve(n * color.hidden_stride);
    color_slopes = color_slopes_.reserve(n * kColorSlopes);
    rgb = rgb_.reserve(3 * n);
    grad_rgb = grad_rgb_.reserve(3 * n);
    rgb_stride = n;
    g1 = g1_.reserve(kTileRows * geometry.hidden_stride);
    g2 = g2_.reserve(kTileRows * geometry.hidden_stride);
    grad_x = grad_x_.reserve(kTileRows * color.input_stride);
  }

  std::int32_t samples_per_ray;
  std::int64_t num_rays;
  Ray rays[kChunkRays];
  RayPoseGradient pose_gradients[kChunkRays];

  // All samples, ray by ray in order of depth.
  float *depth_scratch, *depths;
  std::int64_t* keys;
  std::int32_t* cell_of;  // index into cells, -1 where there is no voxel

  ChunkCell* cells;
  std::int64_t num_cells;

  // Samples inside the volume, in the same order.
  std::int64_t num_inside;
  float* t;
  std::int32_t *voxel_of, *ray_of;
  Vec3<float>* local;
  float *x, *h1, *h2, *slopes;
  float *sdf, *bells, *bell_slopes, *weights, *grad_sdf;

  // Rendered samples, in the same order.
  std::int64_t num_colors;
  std::int32_t* color_sample;  // index among the samples inside
  float *color_x, *color_h1, *color_h2, *color_slopes;
  float *rgb, *grad_rgb;  // [3, rgb_stride]
  std::int64_t rgb_stride;

  // Of one tile in the backward pass.
  float *g1, *g2, *grad_x;

 private:
  ScratchBuffer<float> depth_scratch_, depths_, t_, x_, h1_, h2_, slopes_, sdf_, bells_, bell_slopes_, weights_,
      grad_sdf_, color_x_, color_h1_, color_h2_, color_slopes_, rgb_, grad_rgb_, g1_, g2_, grad_x_;
  ScratchBuffer<std::int64_t> keys_;
  ScratchBuffer<std::int32_t> cell_of_, voxel_of_, ray_of_, color_sample_;
  ScratchBuffer<ChunkCell> cells_;
  ScratchBuffer<Vec3<float>> local_;
};

// Gradients of samples before they are added to the tables: chunk c writes rows and runs from c * kChunkRays *
// num_samples on.
struct TableGradients {
  std::int64_t capacity;  // rows that a chunk may write
  std::int64_t rows;      // of all chunks

  std::int64_t* num_embedding_runs;  // [chunks]
  EmbeddingRun* embedding_runs;
  float* embedding;  // gradient rows of the geometry decoder's input
  Vec3<float>* local;

  std::int64_t* num_texel_runs;  // [chunks, 3]
  TexelRun* texel_runs;          // [3, rows]
  float* texel;                  // gradient rows of the color decoder's input
  PlaneFraction* fractions;      // [3, rows]
};

}  // namespace spslam::render
