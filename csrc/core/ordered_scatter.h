// Sums of many weighted items into the rows of a table, in parallel, each row in the order of its items: the bits are
// those of a serial loop, whatever the number of threads. CPU only.
#pragma once

#include <cstdint>
#include <vector>

#include "core/parallel.h"

namespace spslam {

namespace detail {

// Rows are dealt out in blocks of 2^shift neighbours, which also keeps a block's rows in the cache while it is summed.
struct RowBlocks {
  static constexpr std::int64_t kMaxBlocks = 256;
  int shift = 6;
  std::int64_t count;

  explicit RowBlocks(std::int64_t num_rows) {
    while ((num_rows >> shift) >= kMaxBlocks) ++shift;
    count = (num_rows >> shift) + 1;
  }
};

template <class T>
struct ScatterEntry {
  std::uint32_t item, row;  // counted from the first item of the slice, and from the first row of the block
  T weight;
};

}  // namespace detail

// load(item, stencil): whether the item adds to anything; stencil.rows[K] and stencil.weights[K] say to what.
// add(item, row, weight): adds to one row; called by one thread for any row at a time.
template <class Stencil, int K, class T, class Load, class Add>
void ordered_scatter(std::int64_t num_items, std::int64_t num_rows, const Load& load, const Add& add) {
  constexpr std::int64_t kSlice = (std::int64_t{1} << 20) / K;  // items sorted at a time: bounds the memory
  constexpr std::int64_t kGrain = 4096;
  constexpr std::int64_t kSmall = 256;  // items not worth sorting
  if (num_items <= kSmall) {
    Stencil stencil;
    for (std::int64_t i = 0; i < num_items; ++i) {
      if (!load(i, stencil)) continue;
      for (int k = 0; k < K; ++k) add(i, stencil.rows[k], stencil.weights[k]);
    }
    return;
  }

  const detail::RowBlocks blocks(num_rows);
  const std::int64_t slice_size = num_items < kSlice ? num_items : kSlice;
  std::vector<detail::ScatterEntry<T>> entries(static_cast<std::size_t>(slice_size * K));
  std::vector<std::uint32_t> cursors(static_cast<std::size_t>(chunk_count(slice_size, kGrain) * blocks.count));
  std::vector<std::uint32_t> block_begins(static_cast<std::size_t>(blocks.count + 1));
  for (std::int64_t first = 0; first < num_items; first += kSlice) {
    const std::int64_t size = num_items - first < kSlice ? num_items - first : kSlice;
    const std::int64_t chunks = chunk_count(size, kGrain);

    parallel_chunks(size, kGrain, [&](std::int64_t chunk, std::int64_t begin, std::int64_t end) {
      std::uint32_t* counts = cursors.data() + chunk * blocks.count;
      for (std::int64_t b = 0; b < blocks.count; ++b) counts[b] = 0;
      Stencil stencil;
      for (std::int64_t i = begin; i < end; ++i) {
        if (!load(first + i, stencil)) continue;
        for (int k = 0; k < K; ++k) ++counts[stencil.rows[k] >> blocks.shift];
      }
    });

    std::uint32_t total = 0;
    for (std::int64_t b = 0; b < blocks.count; ++b) {
      block_begins[b] = total;
      for (std::int64_t chunk = 0; chunk < chunks; ++chunk) {
        std::uint32_t& cursor = cursors[chunk * blocks.count + b];
        const std::uint32_t count = cursor;
        cursor = total;
        total += count;
      }
    }
    block_begins[blocks.count] = total;

    parallel_chunks(size, kGrain, [&](std::int64_t chunk, std::int64_t begin, std::int64_t end) {
      std::uint32_t* cursor = cursors.data() + chunk * blocks.count;
      Stencil stencil;
      for (std::int64_t i = begin; i < end; ++i) {
        if (!load(first + i, stencil)) continue;
        for (int k = 0; k < K; ++k) {
          const std::int64_t block = stencil.rows[k] >> blocks.shift;
          const std::int64_t row = stencil.rows[k] - (block << blocks.shift);
          entries[cursor[block]++] = {static_cast<std::uint32_t>(i), static_cast<std::uint32_t>(row),
                                      stencil.weights[k]};
        }
      }
    });

    parallel_for(blocks.count, 1, [&](std::int64_t begin, std::int64_t end) {
      for (std::int64_t b = begin; b < end; ++b) {
        for (std::uint32_t e = block_begins[b]; e < block_begins[b + 1]; ++e) {
          add(first + entries[e].item, (b << blocks.shift) + entries[e].row, entries[e].weight);
        }
      }
    });
  }
}

}  // namespace spslam
