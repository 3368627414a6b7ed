#include <algorithm>
#include <cstring>
#include <vector>

#include "core/for_each.h"
#include "core/parallel.h"
#include "cpu/plane_lanes.h"
#include "kernels/tsdf.h"
#include "kernels/tsdf_view.h"

namespace spslam {
namespace {

// Rows of pixels in a chunk: what a pixel touches as the one above it does is left out within a chunk only.
constexpr std::int64_t kTouchRows = 16;
constexpr int kTouchLanes = 64;

// Pixels that are looked at: every step-th one of the image.
struct TouchGrid {
  const PlaneFrame& frame;
  std::int32_t step;
  std::int64_t columns, rows;

  TouchGrid(const PlaneFrame& image, std::int32_t pixels)
      : frame(image),
        step(pixels),
        columns((image.width + pixels - 1) / pixels),
        rows((image.height + pixels - 1) / pixels) {}
};

// The world and the length of the rays in it.
struct TouchReach {
  Pose<float> pose;
  float inverse_block_size;
  TouchOptions options;
};

// Blocks that the rays of a row of pixels pass: one array per sample along the rays and axis, each behind a column that
// touches nothing.
class TouchedRow {
 public:
  TouchedRow(std::int32_t* memory, std::int64_t columns) : memory_(memory), stride_(stride(columns)) {
    std::fill(memory, memory + size(columns), kNoBlock);
  }

  static std::int64_t size(std::int64_t columns) { return 3 * kTouchedPerPixel * stride(columns); }

  std::int32_t* axis(int sample, int axis) const { return memory_ + (3 * sample + axis) * stride_ + 1; }

 private:
  static std::int64_t stride(std::int64_t columns) { return 1 + round_up(columns, kTouchLanes); }

  std::int32_t* memory_;
  std::int64_t stride_;
};

// Writes the blocks of the pixels [first, first + kTouchLanes) of a row of the grid that there are.
void touch_batch(const TouchGrid& grid, const TouchReach& reach, std::int64_t row, std::int64_t first,
                 const TouchedRow& out) {
  const std::int64_t v = row * grid.step, count = grid.columns - first;
  PlaneLanes<kTouchLanes> planes;
  planes.load(grid.frame.planes,
              [&](int m) { return m < count ? v * grid.frame.width + (first + m) * grid.step : -1; });
  alignas(64) float x[2][kTouchLanes], y[2][kTouchLanes], z[2][kTouchLanes];
  alignas(64) std::int32_t known[kTouchLanes];
  const Intrinsics camera = grid.frame.camera;
  const TouchReach world = reach;
  const float line = static_cast<float>(v);
  const float begin = static_cast<float>(first * grid.step), step = static_cast<float>(grid.step);
  SPS_SIMD for (int m = 0; m < kTouchLanes; ++m) {
    const TouchedRay ray = touched_ray(planes[m], camera, world.options, begin + static_cast<float>(m) * step, line);
    x[0][m] = ray.first.x, y[0][m] = ray.first.y, z[0][m] = ray.first.z;
    x[1][m] = ray.step.x, y[1][m] = ray.step.y, z[1][m] = ray.step.z;
    known[m] = ray.known;
  }
  for (int k = 0; k < kTouchedPerPixel; ++k) {
    std::int32_t *i = out.axis(k, 0) + first, *j = out.axis(k, 1) + first, *l = out.axis(k, 2) + first;
    SPS_SIMD for (int m = 0; m < kTouchLanes; ++m) {
      const VoxelCoord at = touched_block({x[0][m], y[0][m], z[0][m]}, {x[1][m], y[1][m], z[1][m]}, k, world.pose,
                                          world.inverse_block_size);
      i[m] = known[m] ? at.x : kNoBlock, j[m] = at.y, l[m] = at.z;
    }
  }
}

// The blocks of a chunk, each written once but where two meet in one place of the cache.
class TouchedBlocks {
 public:
  explicit TouchedBlocks(std::int32_t* coords) : begin_(coords), end_(coords) {
    std::fill(cache_, cache_ + kPlaces, VoxelCoord{kNoBlock, 0, 0});
  }

  void append(const VoxelCoord& block) {
    constexpr std::int32_t kMask = kSide - 1;
    VoxelCoord& cached = cache_[((block.x & kMask) * kSide + (block.y & kMask)) * kSide + (block.z & kMask)];
    if (same_block(block, cached)) return;
    cached = block;
    end_[0] = block.x, end_[1] = block.y, end_[2] = block.z;
    end_ += 3;
  }

  std::int64_t count() const { return (end_ - begin_) / 3; }

 private:
  // Blocks that lie this far apart meet: along a row of pixels they seldom follow one another.
  static constexpr int kSide = 8, kPlaces = kSide * kSide * kSide;

  VoxelCoord cache_[kPlaces];
  std::int32_t *begin_, *end_;
};

// Appends the blocks of a row but those that the same sample of the pixel above or on the left touches too, or the
// pixel's own sample before.
void append_new(std::int64_t columns, const TouchedRow& own, const TouchedRow& above, TouchedBlocks& blocks) {
  const auto at = [](const TouchedRow& row, int k, std::int64_t column) {
    return VoxelCoord{row.axis(k, 0)[column], row.axis(k, 1)[column], row.axis(k, 2)[column]};
  };
  for (int k = 0; k < kTouchedPerPixel; ++k) {
    for (std::int64_t first = 0; first < columns; first += kTouchLanes) {
      alignas(64) std::int32_t is_new[kTouchLanes];
      std::int32_t any = 0;
#pragma omp simd reduction(| : any)
      for (int m = 0; m < kTouchLanes; ++m) {
        const std::int64_t column = first + m;
        const VoxelCoord block = at(own, k, column);
        const bool known = same_block(block, at(own, k, column - 1)) | same_block(block, at(above, k, column)) |
                           ((k > 0) & same_block(block, at(own, k > 0 ? k - 1 : 0, column)));
        is_new[m] = (block.x != kNoBlock) & !known;
        any |= is_new[m];
      }
      if (!any) continue;
      for (int m = 0; m < kTouchLanes; ++m) {
        if (is_new[m]) blocks.append(at(own, k, first + m));
      }
    }
  }
}

// Writes the blocks of the rows [begin, end) of the grid; returns how many.
std::int64_t touch_rows(const TouchGrid& grid, const TouchReach& reach, std::int64_t begin, std::int64_t end,
                        std::int32_t* coords) {
  ScratchBuffer<std::int32_t> buffer;
  std::int32_t* memory = buffer.reserve(2 * TouchedRow::size(grid.columns));
  TouchedRow own(memory, grid.columns), above(memory + TouchedRow::size(grid.columns), grid.columns);
  TouchedBlocks blocks(coords);
  for (std::int64_t row = begin; row < end; ++row) {
    for (std::int64_t first = 0; first < grid.columns; first += kTouchLanes) {
      touch_batch(grid, reach, row, first, own);
    }
    append_new(grid.columns, own, above, blocks);
    std::swap(own, above);
  }
  return blocks.count();
}

}  // namespace

template <>
std::int64_t tsdf_touched_blocks<Cpu>(Cpu, const PlaneFrame& frame, const TouchOptions& options, std::int32_t* coords) {
  const TouchGrid grid(frame, options.step);
  if (grid.columns == 0 || grid.rows == 0) return 0;
  const TouchReach reach{load_pose(frame.pose), 1.0f / (kTsdfBlockSide * options.voxel_size), options};
  const std::int64_t most = 3 * kTouchedPerPixel * grid.columns;
  std::vector<std::int64_t> counts(chunk_count(grid.rows, kTouchRows));
  parallel_chunks(grid.rows, kTouchRows, [&](std::int64_t chunk, std::int64_t begin, std::int64_t end) {
    counts[chunk] = touch_rows(grid, reach, begin, end, coords + most * begin);
  });
  std::int64_t total = 0;
  for (std::size_t chunk = 0; chunk < counts.size(); ++chunk) {
    const std::int32_t* from = coords + most * kTouchRows * static_cast<std::int64_t>(chunk);
    std::memmove(coords + 3 * total, from, 3 * sizeof(std::int32_t) * static_cast<std::size_t>(counts[chunk]));
    total += counts[chunk];
  }
  return total;
}

template <>
std::int64_t tsdf_missing_blocks<Cpu>(Cpu, const VoxelTable& table, const std::int32_t* coords, std::int64_t n,
                                      void* workspace, std::int32_t* missing) {
  std::uint8_t* is_missing = static_cast<std::uint8_t*>(workspace);
  parallel_for(n, kElementGrain, [&](std::int64_t begin, std::int64_t end) {
    for (std::int64_t i = begin; i < end; ++i) is_missing[i] = is_missing_block(table, load_voxel(coords, i));
  });
  std::int64_t count = 0;
  for (std::int64_t i = 0; i < n; ++i) {
    if (is_missing[i]) std::copy_n(coords + 3 * i, 3, missing + 3 * count++);
  }
  return count;
}

}  // namespace spslam
