// Last part of render_step on the CPU: gradient rows of samples added to the rows of the tables.
//
// Tables are divided into parts, each filled by one thread that goes through all samples in order: sums have one
// order, whatever the number of threads. Neighbors along a ray mostly share a cell, so sums are kept in registers
// over a run of samples in one cell; the rows of later runs are prefetched.
#pragma once

#include "cpu/render_step_color.h"
#include "kernels/interpolation.h"

namespace spslam::render {

// Parts of a plane: halves of its channels, one cache line each.
constexpr std::int64_t kTexelParts = 2, kTexelPartChannels = kPlaneChannels / kTexelParts;
constexpr std::int64_t kScatterParts = kEmbeddingParts + 3 * kTexelParts;
constexpr std::int64_t kRunsAhead = 8;

inline void prefetch_embedding_rows(const RenderGradients& out, const EmbeddingRun& run, std::int64_t part) {
  for (int k = 0; k < kCellCorners; ++k) {
    if (!(run.owned[part] >> k & 1)) continue;
    __builtin_prefetch(out.embeddings + kEmbeddingChannels * std::int64_t{run.corners[k]}, 1);
    if (out.embedding_stamps) __builtin_prefetch(out.embedding_stamps + run.corners[k], 1);
  }
}

inline void scatter_embeddings(const RenderGradients& out, const TableGradients& tables, std::int64_t chunk,
                               std::int64_t stride, std::int64_t part) {
  const std::int64_t first = chunk * tables.capacity, count = tables.num_embedding_runs[chunk];
  const EmbeddingRun* runs = tables.embedding_runs + first;
  for (std::int64_t r = 0; r < count; ++r) {
    if (r + kRunsAhead < count) prefetch_embedding_rows(out, runs[r + kRunsAhead], part);
    const EmbeddingRun& run = runs[r];
    if (!run.owned[part]) continue;
    Feature sums[kCellCorners] = {};
    for (std::int64_t i = first + (r > 0 ? runs[r - 1].end : 0); i < first + run.end; ++i) {
      const Feature grad = load_vector<Feature>(tables.embedding + i * stride + 3);
      for (int k = 0; k < kCellCorners; ++k) sums[k] += trilinear_weight(tables.local[i], k) * grad;
    }
    for (int k = 0; k < kCellCorners; ++k) {
      if (!(run.owned[part] >> k & 1)) continue;
      float* row = out.embeddings + kEmbeddingChannels * std::int64_t{run.corners[k]};
      store_vector(row, load_vector<Feature>(row) + sums[k]);
      if (out.embedding_stamps) out.embedding_stamps[run.corners[k]] = out.stamp;
    }
  }
}

inline void scatter_texels(const PlaneTexels& plane, int index, const RenderGradients& out,
                           const TableGradients& tables, std::int64_t chunk, std::int64_t half) {
  using V = Vector<float>;
  constexpr int kVectors = static_cast<int>(kTexelPartChannels) / kLanes<float>;
  const std::int64_t first = chunk * tables.capacity, count = tables.num_texel_runs[3 * chunk + index];
  const std::int64_t channel = half * kTexelPartChannels;
  const TexelRun* runs = tables.texel_runs + index * tables.rows + first;
  const PlaneFraction* fractions = tables.fractions + index * tables.rows + first;
  const auto row_of = [&plane](const TexelRun& run, int k) {
    return run.row + (k & 1 ? plane.step_u : 0) + (k & 2 ? plane.step_v : 0);
  };
  for (std::int64_t r = 0; r < count; ++r) {
    for (int k = 0; r + kRunsAhead < count && k < 4; ++k) {
      __builtin_prefetch(out.texels + row_of(runs[r + kRunsAhead], k) * kPlaneChannels + channel, 1);
    }
    V sums[4][kVectors] = {};
    for (std::int64_t i = r > 0 ? runs[r - 1].end : 0; i < runs[r].end; ++i) {
      float weights[4];
      bilinear_weights(fractions[i].u, fractions[i].v, weights);
      for (int v = 0; v < kVectors; ++v) {
        const V g = load_vector<V>(tables.texel + (first + i) * kPlaneChannels + channel + v * kLanes<float>);
        for (int k = 0; k < 4; ++k) sums[k][v] += weights[k] * g;
      }
    }
    for (int k = 0; k < 4; ++k) {
      float* texel = out.texels + row_of(runs[r], k) * kPlaneChannels + channel;
      for (int v = 0; v < kVectors; ++v) {
        store_vector(texel + v * kLanes<float>, load_vector<V>(texel + v * kLanes<float>) + sums[k][v]);
      }
      if (out.texel_stamps && half == 0) out.texel_stamps[row_of(runs[r], k)] = out.stamp;
    }
  }
}

// One part of the tables, of kScatterParts.
inline void scatter_part(const SceneView& scene, const RenderGradients& out, const Plan& plan,
                         const TableGradients& tables, std::int64_t chunks, std::int64_t embedding_stride,
                         std::int64_t part) {
  if (part < kEmbeddingParts) {
    for (std::int64_t c = 0; plan.embeddings && c < chunks; ++c) {
      scatter_embeddings(out, tables, c, embedding_stride, part);
    }
  } else if (plan.texels) {
    const std::int64_t texel_part = part - kEmbeddingParts;
    const int index = static_cast<int>(texel_part / kTexelParts);
    const PlaneTexels plane(scene.texels, scene.planes.planes[index]);
    for (std::int64_t c = 0; c < chunks; ++c) {
      scatter_texels(plane, index, out, tables, c, texel_part % kTexelParts);
    }
  }
}

}  // namespace spslam::render
