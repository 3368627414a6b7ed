#include "launch/prior_fusion.h"

#include <algorithm>
#include <vector>

#include "cpu/point_encoder.h"
#include "kernels/voxel_hash.h"

namespace spslam {
namespace {

constexpr std::int64_t kCellsAtOnce = 8192;  // limits the memory for a long list of points
constexpr std::int64_t kCellGrain = 8;
constexpr int kMaxCorners = 64;

struct KeyedPoint {
  std::int64_t key;
  std::int64_t index;
};

// Sums of features over voxel vertices, in the order in which they are added, and of weights, see sum_scale.
class VertexSums {
 public:
  explicit VertexSums(float weight_scale) : weight_scale_(weight_scale) { resize_table(1 << 14); }

  void add(std::int64_t key, const float* features, std::int64_t weight) {
    const std::int64_t row = row_of(key);
    float* sum = sums_.data() + row * kPriorFeatures;
    for (int c = 0; c < kPriorFeatures; ++c) sum[c] += features[c];
    weights_[row] += weight;
  }

  // Writes means and weights, sorted by key.
  void write(const AllocateEncodedVoxels& allocate) const {
    const std::int64_t count = static_cast<std::int64_t>(keys_.size());
    std::vector<KeyedPoint> order(keys_.size());
    for (std::int64_t row = 0; row < count; ++row) order[row] = {keys_[row], row};
    std::sort(order.begin(), order.end(), [](const KeyedPoint& a, const KeyedPoint& b) { return a.key < b.key; });
    const EncodedVoxels out = allocate(count);
    for (std::int64_t i = 0; i < count; ++i) {
      const VoxelCoord coord = unpack_voxel(order[i].key);
      const std::int64_t row = order[i].index;
      out.voxel_coords[3 * i] = coord.x;
      out.voxel_coords[3 * i + 1] = coord.y;
      out.voxel_coords[3 * i + 2] = coord.z;
      const float weight = weight_of_units(weights_[row], weight_scale_);
      out.weights[i] = weight;
      for (int c = 0; c < kPriorFeatures; ++c) {
        out.features[kPriorFeatures * i + c] = sums_[kPriorFeatures * row + c] / weight;
      }
    }
  }

 private:
  std::int64_t row_of(std::int64_t key) {
    std::int64_t slot = voxel_slot(key, mask_);
    for (; slots_[slot].key != kEmptyVoxelKey; slot = (slot + 1) & mask_) {
      if (slots_[slot].key == key) return slots_[slot].index;
    }
    const std::int64_t row = static_cast<std::int64_t>(keys_.size());
    slots_[slot] = {key, row};
    keys_.push_back(key);
    weights_.push_back(0);
    sums_.resize(sums_.size() + kPriorFeatures, 0.0f);
    if (2 * (row + 1) > mask_) resize_table(2 * (mask_ + 1));
    return row;
  }

  void resize_table(std::int64_t capacity) {
    mask_ = capacity - 1;
    slots_.assign(static_cast<std::size_t>(capacity), {kEmptyVoxelKey, 0});
    for (std::size_t row = 0; row < keys_.size(); ++row) {
      std::int64_t slot = voxel_slot(keys_[row], mask_);
      while (slots_[slot].key != kEmptyVoxelKey) slot = (slot + 1) & mask_;
      slots_[slot] = {keys_[row], static_cast<std::int64_t>(row)};
    }
  }

  std::int64_t mask_ = 0;
  std::vector<KeyedPoint> slots_;
  const float weight_scale_;
  std::vector<std::int64_t> keys_, weights_;
  std::vector<float> sums_;
};

// The points of valid cells, grouped by cell, and where each cell begins.
struct CellList {
  CellList(const float* points, const float* normals, std::int64_t n, float inverse_voxel_size) {
    members.resize(static_cast<std::size_t>(n));
    for_each(Cpu{}, n, [&](std::int64_t i) {
      const EncodedPoint point = locate_point(points + 3 * i, normals + 3 * i, inverse_voxel_size);
      members[i] = {point.valid ? pack_voxel(point.cell) : kEmptyVoxelKey, i};
    });
    members.erase(std::remove_if(members.begin(), members.end(), [](const KeyedPoint& p) { return p.key < 0; }),
                  members.end());
    std::sort(members.begin(), members.end(), [](const KeyedPoint& a, const KeyedPoint& b) {
      return a.key != b.key ? a.key < b.key : a.index < b.index;
    });
    for (std::size_t i = 0; i < members.size(); ++i) {
      if (i == 0 || members[i].key != members[i - 1].key) begins.push_back(static_cast<std::int64_t>(i));
    }
    begins.push_back(static_cast<std::int64_t>(members.size()));
  }

  std::int64_t count() const { return static_cast<std::int64_t>(begins.size()) - 1; }

  std::vector<KeyedPoint> members;
  std::vector<std::int64_t> begins;
};

// One call of encode_points.
class Encoding {
 public:
  Encoding(const float* points, const float* normals, std::int64_t n, const float* params,
           const EncoderSettings& settings)
      : points_(points),
        normals_(normals),
        inverse_voxel_size_(1.0f / settings.voxel_size),
        min_pair_weight_(settings.min_pair_weight),
        weight_scale_(weight_scale(n)),
        neighborhood_(neighborhood_of(settings.neighborhood)),
        net_(params),
        cells_(points, normals, n, inverse_voxel_size_),
        sums_(weight_scale_) {}

  void run(const AllocateEncodedVoxels& allocate) {
    for (std::int64_t first = 0; first < cells_.count(); first += kCellsAtOnce) {
      const std::int64_t count = std::min(kCellsAtOnce, cells_.count() - first);
      find_entries(first, count);
      encode_cells(first, count);
      add_entries(first, count);
    }
    sums_.write(allocate);
  }

 private:
  template <class F>
  void for_each_point(std::int64_t cell, const F& f) const {
    for (std::int64_t i = cells_.begins[cell]; i < cells_.begins[cell + 1]; ++i) {
      const std::int64_t index = cells_.members[i].index;
      const EncodedPoint point = locate_point(points_ + 3 * index, normals_ + 3 * index, inverse_voxel_size_);
      f(CellPoint(neighborhood_, point.local), normals_ + 3 * index);
    }
  }

  // Which vertices each cell reaches, and the indices of their sums.
  void find_entries(std::int64_t first, std::int64_t count) {
    corners_.assign(static_cast<std::size_t>(count), 0);
    entry_begins_.assign(static_cast<std::size_t>(count) + 1, 0);
    parallel_for(count, 4 * kCellGrain, [&](std::int64_t begin, std::int64_t end) {
      for (std::int64_t cell = begin; cell < end; ++cell) {
        std::uint64_t corners = 0;
        for_each_point(first + cell, [&](const CellPoint& point, const float*) {
          point.for_each_pair(neighborhood_, min_pair_weight_,
                              [&](int corner, int, int, int, float) { corners |= std::uint64_t{1} << corner; });
        });
        corners_[cell] = corners;
      }
    });
    for (std::int64_t cell = 0; cell < count; ++cell) {
      entry_begins_[cell + 1] = entry_begins_[cell] + __builtin_popcountll(corners_[cell]);
    }
    features_.reserve(entry_begins_[count] * kPriorFeatures);
    weights_.reserve(entry_begins_[count]);
  }

  void encode_cells(std::int64_t first, std::int64_t count) {
    parallel_for(count, kCellGrain, [&](std::int64_t begin, std::int64_t end) {
      PointEncoder encoder(net_, kCellGrain * kMaxCorners, weight_scale_);
      const std::int64_t base = entry_begins_[begin];
      encoder.begin(entry_begins_[end] - base, weights_.get() + base);
      for (std::int64_t cell = begin; cell < end; ++cell) {
        std::int32_t entry_of_corner[kMaxCorners];
        std::int32_t entry = static_cast<std::int32_t>(entry_begins_[cell] - base);
        for (int corner = 0; corner < kMaxCorners; ++corner) {
          entry_of_corner[corner] = entry;
          entry += (corners_[cell] >> corner) & 1;
        }
        for_each_point(first + cell, [&](const CellPoint& point, const float* normal) {
          encoder.add(neighborhood_, point, normal, min_pair_weight_, entry_of_corner);
        });
      }
      encoder.finish(features_.get() + base * kPriorFeatures);
    });
  }

  void add_entries(std::int64_t first, std::int64_t count) {
    const int side = neighborhood_.side;
    std::int64_t entry = 0;
    for (std::int64_t cell = 0; cell < count; ++cell) {
      const VoxelCoord c = unpack_voxel(cells_.members[cells_.begins[first + cell]].key);
      for (std::uint64_t left = corners_[cell]; left != 0; left &= left - 1, ++entry) {
        const int corner = __builtin_ctzll(left);
        const VoxelCoord vertex{c.x + neighborhood_.first + corner / (side * side),
                                c.y + neighborhood_.first + corner / side % side,
                                c.z + neighborhood_.first + corner % side};
        sums_.add(pack_voxel(vertex), features_.get() + entry * kPriorFeatures, weights_.get()[entry]);
      }
    }
  }

  const float *points_, *normals_;
  const float inverse_voxel_size_, min_pair_weight_, weight_scale_;
  const Neighborhood neighborhood_;
  const PackedEncoder net_;
  const CellList cells_;
  std::vector<std::uint64_t> corners_;
  std::vector<std::int64_t> entry_begins_;
  ScratchBuffer<float> features_;
  ScratchBuffer<std::int64_t> weights_;
  VertexSums sums_;
};

}  // namespace

template <>
void encode_points<Cpu>(Cpu, const float* points, const float* normals, std::int64_t n, const float* params,
                        const EncoderSettings& settings, const AllocateScratch&,
                        const AllocateEncodedVoxels& allocate) {
  Encoding(points, normals, n, params, settings).run(allocate);
}

SPS_INSTANTIATE_PRIOR_FUSION(Cpu)

}  // namespace spslam
