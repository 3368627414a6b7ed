#include "kernels/color_registration.h"

#include <algorithm>
#include <cstring>
#include <limits>

#include "cpu/simd.h"

namespace spslam {
namespace {

// Pixels whose places are computed together.
constexpr std::int32_t kPixelLanes = 64;
constexpr int kChannels = 3;
// The cell of points that the color camera doesn't see: the corner of the depth buffer's border.
constexpr std::int32_t kNoCell = 0;

// A pixel and the next one are read as so many bytes; so many pairs fill a vector of 16-bit numbers.
constexpr int kPairBytes = 8;
constexpr int kPairs = kLanes<std::uint16_t> / kPairBytes;
using Pairs = Vector<std::uint64_t, kPairBytes * kPairs>;
using Bytes = Vector<std::uint8_t, kPairBytes * kPairs>;
using Words = Vector<std::uint16_t>;

// Nearest depths of the color camera's view, with a border of one cell.
class CellGrid {
 public:
  CellGrid(std::int32_t wide, std::int32_t high)
      : wide_(wide), high_(high), stride_(wide + 2), cells_(static_cast<std::int64_t>(stride_) * (high + 2)) {}

  void clear(ScratchBuffer<float>& buffer) {
    nearest_ = buffer.reserve(2 * cells_);
    columns_ = nearest_ + cells_;
    std::fill(nearest_, nearest_ + cells_, std::numeric_limits<float>::infinity());
  }

  std::int32_t stride() const { return stride_; }
  float* nearest() { return nearest_; }

  // Replaces each cell by the nearest one of the 3x3 around it: its own may be a gap between the points of a surface.
  // What lies in kNoCell is behind everything.
  void widen() {
    nearest_[kNoCell] = std::numeric_limits<float>::infinity();
    for (std::int32_t r = 1; r <= high_; ++r) {
      const float* row = nearest_ + static_cast<std::int64_t>(r) * stride_;
      float* lowest = columns_ + static_cast<std::int64_t>(r) * stride_;
      SPS_SIMD for (std::int32_t c = 0; c < stride_; ++c) {
        lowest[c] = smaller(row[c], smaller(row[c - stride_], row[c + stride_]));
      }
    }
    for (std::int32_t r = 1; r <= high_; ++r) {
      const float* lowest = columns_ + static_cast<std::int64_t>(r) * stride_;
      float* row = nearest_ + static_cast<std::int64_t>(r) * stride_;
      SPS_SIMD for (std::int32_t c = 1; c <= wide_; ++c) {
        row[c] = smaller(lowest[c], smaller(lowest[c - 1], lowest[c + 1]));
      }
    }
    nearest_[kNoCell] = 0.0f;
  }

 private:
  std::int32_t wide_, high_, stride_;
  std::int64_t cells_;
  float* nearest_ = nullptr;
  float* columns_ = nullptr;
};

// Where the pixels of a row fall in the color image, px, and their depth from there.
struct SeenRow {
  float *u, *v, *z;
};

void see_row(const ColorRegistration& registration, const float* depth, std::int32_t row, const SeenRow& seen) {
  const PixelMapRow map = row_of_map(registration.map, static_cast<float>(row));
  const float typical = registration.typical_depth;
  SPS_SIMD for (std::int32_t i = 0; i < registration.width; ++i) {
    const SeenPixel at = seen_pixel(map, static_cast<float>(i), depth[i] > 0.0f ? depth[i] : typical);
    seen.u[i] = at.u;
    seen.v[i] = at.v;
    seen.z[i] = at.z;
  }
}

// Cells of a row's pixels, kNoCell for those without depth and those outside the color image.
void cells_of_row(const ColorRegistration& registration, const float* depth, const SeenRow& seen, std::int32_t stride,
                  std::int32_t* cells) {
  const std::int32_t color_width = registration.color_width, color_height = registration.color_height;
  const std::int32_t wide = std::max(registration.cells_wide, 1), high = std::max(registration.cells_high, 1);
  const float by_u = static_cast<float>(wide) / static_cast<float>(color_width);
  const float by_v = static_cast<float>(high) / static_cast<float>(color_height);
  SPS_SIMD for (std::int32_t i = 0; i < registration.width; ++i) {
    const SeenPixel at{seen.u[i], seen.v[i], seen.z[i]};
    const bool shows = is_in_image(at, color_width, color_height) & (depth[i] > 0.0f);
    const std::int32_t column = static_cast<std::int32_t>(((shows ? at.u : 0.0f) + 0.5f) * by_u);
    const std::int32_t row = static_cast<std::int32_t>(((shows ? at.v : 0.0f) + 0.5f) * by_v);
    const std::int32_t cell = (row + 1) * stride + column + 1;
    cells[i] = shows & (column < wide) & (row < high) ? cell : kNoCell;
  }
}

void put_nearest(const std::int32_t* cells, const float* z, std::int32_t count, float* nearest) {
  for (std::int32_t i = 0; i < count; ++i) {
    float& cell = nearest[cells[i]];
    cell = z[i] < cell ? z[i] : cell;
  }
}

// Takes the cell from pixels that fall where the color image has no content.
void forget_unseen(const ColorRegistration& registration, const std::uint8_t* unseen, const SeenRow& seen,
                   std::int32_t* cells) {
  for (std::int32_t i = 0; i < registration.width; ++i) {
    if (cells[i] == kNoCell) continue;
    const std::int64_t column = static_cast<std::int32_t>(seen.u[i] + 0.5f);
    const std::int64_t row = static_cast<std::int32_t>(seen.v[i] + 0.5f);
    if (unseen[row * registration.color_width + column]) cells[i] = kNoCell;
  }
}

// Colors between the pixels of an image. Places are bytes of the image.
class ColorSampler {
 public:
  ColorSampler(const std::uint8_t* colors, std::int32_t width, std::int32_t height)
      : colors_(colors), width_(width), height_(height), row_bytes_(kChannels * width) {
    // A pixel and the next one are read at once, and those below them; what is read must lie in the image.
    last_pair_ = width > 1 ? row_bytes_ * (height - 1) - kPairBytes : -1;
  }

  // Colors [count, 3] at the columns u and rows v.
  void sample(const float* u, const float* v, std::int32_t count, std::uint8_t* out) const {
    for (std::int32_t first = 0; first < count; first += kPixelLanes) {
      sample_batch(u + first, v + first, std::min(kPixelLanes, count - first), out + kChannels * first);
    }
  }

 private:
  void sample_batch(const float* u, const float* v, std::int32_t count, std::uint8_t* out) const {
    // Weights are read a vector at a time, of which kPairs are used.
    constexpr int kRead = kPixelLanes + kLanes<std::uint16_t>;
    alignas(64) std::int32_t places[kPixelLanes];
    alignas(64) std::uint16_t by_u[kRead], by_v[kRead];
    std::fill(places + count, places + kPixelLanes, 0);
    std::fill(by_u + count, by_u + kRead, std::uint16_t{0});
    std::fill(by_v + count, by_v + kRead, std::uint16_t{0});
    std::int32_t room = 0;  // negative where a pixel lies behind the last pair
    SPS_SIMD_MIN(room) for (std::int32_t i = 0; i < count; ++i) {
      const ColorPlace column = color_place(u[i], width_), row = color_place(v[i], height_);
      places[i] = row.pixel * row_bytes_ + kChannels * column.pixel;
      room = std::min(room, last_pair_ - places[i]);
      by_u[i] = static_cast<std::uint16_t>(column.weight);
      by_v[i] = static_cast<std::uint16_t>(row.weight);
    }
    // A pixel is written as four bytes, of which the next one overwrites the last.
    alignas(64) std::uint8_t sampled[kChannels * kPixelLanes + 1];
    if (last_pair_ >= 0) {
      for (std::int32_t i = 0; i < kPixelLanes; i += kPairs) {
        put_pairs(places + i, by_u + i, by_v + i, sampled + kChannels * i);
      }
    }
    for (std::int32_t i = 0; room < 0 && i < count; ++i) {
      if (places[i] > last_pair_) put_near_end(places[i], by_u[i], by_v[i], sampled + kChannels * i);
    }
    std::memcpy(out, sampled, kChannels * count);
  }

  // Colors of kPairs pixels, each between the one at its place, the next one, and those below.
  SPS_INLINE void put_pairs(const std::int32_t* places, const std::uint16_t* by_u, const std::uint16_t* by_v,
                            std::uint8_t* out) const {
    Pairs above{}, below{};
    Words of_pair{}, next{};
    for (int k = 0; k < kPairs; ++k) {
      const std::uint8_t* pixel = colors_ + std::min(places[k], last_pair_);
      above[k] = load_vector<std::uint64_t>(pixel);
      below[k] = load_vector<std::uint64_t>(pixel + row_bytes_);
      for (int c = 0; c < kPairBytes; ++c) {
        of_pair[kPairBytes * k + c] = static_cast<std::uint16_t>(k);
        next[kPairBytes * k + c] = static_cast<std::uint16_t>(kPairBytes * k + std::min(c + kChannels, kPairBytes - 1));
      }
    }
    const Words top = __builtin_convertvector(reinterpret_cast<Bytes>(above), Words);
    const Words bottom = __builtin_convertvector(reinterpret_cast<Bytes>(below), Words);
    const Words rows = __builtin_shuffle(load_vector<Words>(by_v), of_pair);
    const Words columns = __builtin_shuffle(load_vector<Words>(by_u), of_pair);
    const Words left = between_rows(top, bottom, rows);
    const Bytes colors = __builtin_convertvector(between_columns(left, __builtin_shuffle(left, next), columns), Bytes);
    const Pairs found = reinterpret_cast<Pairs>(colors);
    for (int k = 0; k < kPairs; ++k) {
      const std::uint64_t color = found[k];
      std::memcpy(out + kChannels * k, &color, kChannels + 1);
    }
  }

  // The same of one pixel where no pair can be read, byte by byte.
  void put_near_end(std::int32_t place, int by_u, int by_v, std::uint8_t* out) const {
    const std::int32_t right = width_ > 1 ? kChannels : 0, below = height_ > 1 ? row_bytes_ : 0;
    for (int c = 0; c < kChannels; ++c) {
      const std::uint8_t* byte = colors_ + place + c;
      const int left = between_rows<int>(byte[0], byte[below], by_v);
      out[c] = static_cast<std::uint8_t>(
          between_columns(left, between_rows<int>(byte[right], byte[right + below], by_v), by_u));
    }
  }

  const std::uint8_t* colors_;
  std::int32_t width_, height_, row_bytes_, last_pair_;
};

// Keeps the depth of a row's pixels that nothing in front hides.
void keep_visible(const ColorRegistration& registration, const std::int32_t* cells, const float* z, const float* front,
                  const float* depth, float* kept) {
  const float share = 1.0f - registration.hidden_share;
  SPS_SIMD for (std::int32_t i = 0; i < registration.width; ++i) {
    kept[i] = (cells[i] != kNoCell) & (z[i] * share <= front[cells[i]]) ? depth[i] : 0.0f;
  }
}

// What a thread needs for an image; kept, as it reads one after the other.
struct Scratch {
  ScratchBuffer<float> places, z, grid;
  ScratchBuffer<std::int32_t> cells;
};

}  // namespace

void register_color(Cpu, const ColorRegistration& registration, const RegisteredImages& images, std::uint8_t* colors,
                    float* depth) {
  static thread_local Scratch scratch;
  const std::int64_t width = registration.width, height = registration.height;
  if (width == 0 || height == 0) return;
  const bool hides = registration.cells_wide > 0;
  CellGrid grid(std::max(registration.cells_wide, 1), std::max(registration.cells_high, 1));
  grid.clear(scratch.grid);
  float* u = scratch.places.reserve(2 * width);
  float* z = scratch.z.reserve(width * height);
  std::int32_t* cells = scratch.cells.reserve(width * height);
  const ColorSampler sampler(images.colors, registration.color_width, registration.color_height);
  for (std::int32_t v = 0; v < height; ++v) {
    const SeenRow seen{u, u + width, z + v * width};
    const float* measured = images.depth + v * width;
    see_row(registration, measured, v, seen);
    if (images.colors) sampler.sample(seen.u, seen.v, registration.width, colors + kChannels * v * width);
    cells_of_row(registration, measured, seen, grid.stride(), cells + v * width);
    if (hides) put_nearest(cells + v * width, seen.z, registration.width, grid.nearest());
    if (images.unseen) forget_unseen(registration, images.unseen, seen, cells + v * width);
  }
  if (hides) grid.widen();
  for (std::int64_t first = 0; first < width * height; first += width) {
    keep_visible(registration, cells + first, z + first, grid.nearest(), images.depth + first, depth + first);
  }
}

}  // namespace spslam
