// The depth encoder on the CPU, for the points of some cells: vectors over hidden units, tiles of point-vertex pairs.
//
// Two properties save most of the work. The first layer is linear in the position relative to the vertex, one axis at
// a time, so a point keeps its part per axis and vertex and a pair only adds three of them. The last layer is linear,
// so it is applied once to the weighted sum of hidden units that a cell gives to a vertex, not to every pair.
#pragma once

#include <cstdint>
#include <cstring>

#include "cpu/mlp_tile.h"
#include "kernels/prior_fusion.h"

namespace spslam {

// Parameters arranged for vectors over outputs.
class PackedEncoder {
 public:
  explicit PackedEncoder(const float* params) {
    constexpr MlpOffsets kAt = kEncoder.offsets();
    transpose(params + kAt.w1, kEncoderHidden, kEncoderInputs, kEncoderHidden, w1);
    transpose(params + kAt.w2, kEncoderHidden, kEncoderHidden, kEncoderHidden, w2);
    transpose(params + kAt.w3, kPriorFeatures, kEncoderHidden, kOutputStride, w3);
    std::memcpy(b1, params + kAt.b1, sizeof b1);
    std::memcpy(b2, params + kAt.b2, sizeof b2);
    std::memcpy(b3, params + kAt.b3, sizeof b3);
  }

  static constexpr int kOutputStride = kPriorFeatures > kLanes<float> ? kPriorFeatures : kLanes<float>;
  alignas(64) float w1[kEncoderInputs * kEncoderHidden];
  alignas(64) float b1[kEncoderHidden];
  alignas(64) float w2[kEncoderHidden * kEncoderHidden];
  alignas(64) float b2[kEncoderHidden];
  alignas(64) float w3[kEncoderHidden * kOutputStride] = {};
  float b3[kPriorFeatures];

 private:
  static void transpose(const float* from, int outputs, int inputs, int stride, float* to) {
    for (int o = 0; o < outputs; ++o) {
      for (int i = 0; i < inputs; ++i) to[i * stride + o] = from[o * inputs + i];
    }
  }
};

// A point in its cell: relative positions to the vertices of each axis.
struct CellPoint {
  CellPoint(const Neighborhood& neighborhood, const Vec3<float>& local) {
    for (int i = 0; i < neighborhood.side; ++i) {
      x[i] = relative_position(neighborhood, local.x, i);
      y[i] = relative_position(neighborhood, local.y, i);
      z[i] = relative_position(neighborhood, local.z, i);
    }
  }

  // Calls f(corner, i, j, k, weight) for every vertex whose pair counts.
  template <class F>
  inline __attribute__((always_inline)) void for_each_pair(const Neighborhood& neighborhood, float min_pair_weight,
                                                           const F& f) const {
    for (int i = 0; i < neighborhood.side; ++i) {
      for (int j = 0; j < neighborhood.side; ++j) {
        for (int k = 0; k < neighborhood.side; ++k) {
          const float weight = pair_weight(x[i], y[j], z[k]);
          if (!pair_counts(weight, min_pair_weight)) continue;
          f((i * neighborhood.side + j) * neighborhood.side + k, i, j, k, weight);
        }
      }
    }
  }

  float x[4], y[4], z[4];
};

// Encodes points one after the other into `entries` (one per vertex of the cell): weighted sums of features, and of
// weights in units of 1 / weight_scale.
class PointEncoder {
 public:
  PointEncoder(const PackedEncoder& net, std::int64_t max_entries, float weight_scale)
      : net_(net),
        weight_scale_(weight_scale),
        h1_(h1_buffer_.reserve(kRows * kEncoderHidden)),
        h2_(h2_buffer_.reserve(kRows * kEncoderHidden)),
        sums_(sums_buffer_.reserve(round_up(max_entries, kRowBlock) * kEncoderHidden)) {}

  void begin(std::int64_t entries, std::int64_t* weights) {
    entries_ = entries;
    weights_ = weights;
    std::memset(sums_, 0, static_cast<std::size_t>(round_up(entries, kRowBlock) * kEncoderHidden) * sizeof(float));
    std::memset(weights, 0, static_cast<std::size_t>(entries) * sizeof(std::int64_t));
  }

  // Adds a point; entry_of_corner[c] is the entry of the cell's vertex c.
  void add(const Neighborhood& neighborhood, const CellPoint& point, const float* normal, float min_pair_weight,
           const std::int32_t* entry_of_corner) {
    first_layer(neighborhood, point, normal);
    point.for_each_pair(neighborhood, min_pair_weight, [&](int corner, int i, int j, int k, float weight) {
      float* out = h1_ + rows_ * kEncoderHidden;
      for (int c = 0; c < kEncoderHidden; c += kLanes<float>) {
        const V sum =
            (load_vector<V>(parts_[0][i] + c) + load_vector<V>(parts_[1][j] + c)) + load_vector<V>(parts_[2][k] + c);
        store_vector(out + c, sum < 0 ? V{} : sum);
      }
      entry_[rows_] = entry_of_corner[corner];
      weight_[rows_] = weight;
      if (++rows_ == kRows) flush();
    });
  }

  // Writes the weighted sums of features [entries, 8].
  void finish(float* features) {
    if (rows_ > 0) flush();
    for (std::int64_t row = 0; row < entries_; row += kRowBlock) {
      detail::for_column_blocks<float>(PackedEncoder::kOutputStride, [&](std::int64_t column, auto vectors) {
        constexpr int N = decltype(vectors)::value;
        V out[kRowBlock][N] = {};
        detail::accumulate<float, kRowBlock, N>(sums_ + row * kEncoderHidden, kEncoderHidden, 1, net_.w3 + column,
                                                PackedEncoder::kOutputStride, kEncoderHidden, out);
        for (int m = 0; m < kRowBlock && row + m < entries_; ++m) {
          float lanes[N * kLanes<float>];
          std::memcpy(lanes, out[m], sizeof lanes);
          const float weight = weight_of_units(weights_[row + m], weight_scale_);
          for (int c = 0; c < N * kLanes<float> && column + c < kPriorFeatures; ++c) {
            features[(row + m) * kPriorFeatures + column + c] = lanes[c] + weight * net_.b3[column + c];
          }
        }
      });
    }
  }

 private:
  using V = Vector<float>;
  static constexpr std::int64_t kRows = 32;  // two layers of a tile and the second matrix fit the L1 cache

  // parts_[axis][vertex]: the contribution of the position along an axis to the first layer; axis 0 also holds those of
  // the bias and the normal.
  void first_layer(const Neighborhood& neighborhood, const CellPoint& point, const float* normal) {
    const float* positions[3] = {point.x, point.y, point.z};
    for (int c = 0; c < kEncoderHidden; c += kLanes<float>) {
      V base = load_vector<V>(net_.b1 + c);
      for (int a = 0; a < 3; ++a) base += normal[a] * load_vector<V>(net_.w1 + (3 + a) * kEncoderHidden + c);
      for (int a = 0; a < 3; ++a) {
        const V slope = load_vector<V>(net_.w1 + a * kEncoderHidden + c);
        for (int i = 0; i < neighborhood.side; ++i) {
          const V part = positions[a][i] * slope;
          store_vector(parts_[a][i] + c, a == 0 ? part + base : part);
        }
      }
    }
  }

  void flush() {
    for (std::int64_t r = rows_; r % kRowBlock != 0; ++r) {
      std::memset(h1_ + r * kEncoderHidden, 0, kEncoderHidden * sizeof(float));
    }
    detail::hidden_layer<float, kWideColumnVectors>(h1_, kEncoderHidden, kEncoderHidden, net_.w2, net_.b2,
                                                    kEncoderHidden, round_up(rows_, kRowBlock), h2_);
    for (std::int64_t r = 0; r < rows_; ++r) {
      float* sum = sums_ + static_cast<std::int64_t>(entry_[r]) * kEncoderHidden;
      for (int c = 0; c < kEncoderHidden; c += kLanes<float>) {
        const V unit = load_vector<V>(h2_ + r * kEncoderHidden + c);
        store_vector(sum + c, load_vector<V>(sum + c) + weight_[r] * unit);
      }
      weights_[entry_[r]] += weight_units(weight_[r], weight_scale_);
    }
    rows_ = 0;
  }

  const PackedEncoder& net_;
  const float weight_scale_;
  ScratchBuffer<float> h1_buffer_, h2_buffer_, sums_buffer_;
  float *const h1_, *const h2_, *const sums_;
  std::int64_t* weights_ = nullptr;
  std::int64_t entries_ = 0, rows_ = 0;
  alignas(64) float parts_[3][4][kEncoderHidden];
  std::int32_t entry_[kRows];
  float weight_[kRows];
};

}  // namespace spslam
