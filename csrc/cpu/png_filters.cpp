#include "spslam/png_filters.h"

#include <algorithm>
#include <cstring>
#include <tuple>
#include <utility>

#include "core/macros.h"
#include "cpu/simd.h"

namespace spslam {
namespace {

enum Filter : std::uint8_t { kNone, kSub, kUp, kAverage, kPaeth };

// Rows that are undone together where all have Paeth's filter: each byte waits for the one before it in its row, and
// rows that lag one another by a pixel wait at the same time.
constexpr int kTogether = 4;

// A pixel's bytes take so many lanes, one row's behind another's.
constexpr int lanes_of(int pixel_bytes) {
  return pixel_bytes == 3 ? 4 : pixel_bytes;
}

// A pixel as one number, which vectors take and give at once.
using PixelNumbers = std::tuple<std::uint8_t, std::uint16_t, std::uint32_t, std::uint32_t>;
template <int kBytes>
using PixelNumber = std::tuple_element_t<kBytes - 1, PixelNumbers>;

template <int kBytes>
void undo_sub(const std::uint8_t* in, std::int64_t row_bytes, std::uint8_t* out) {
  std::uint8_t left[kBytes] = {};
  for (std::int64_t i = 0; i < row_bytes; i += kBytes) {
    for (int k = 0; k < kBytes; ++k) out[i + k] = left[k] = static_cast<std::uint8_t>(in[i + k] + left[k]);
  }
}

void undo_up(const std::uint8_t* in, const std::uint8_t* above, std::int64_t row_bytes, std::uint8_t* out) {
  SPS_SIMD for (std::int64_t i = 0; i < row_bytes; ++i) out[i] = static_cast<std::uint8_t>(in[i] + above[i]);
}

template <int kBytes>
void undo_average(const std::uint8_t* in, const std::uint8_t* above, std::int64_t row_bytes, std::uint8_t* out) {
  std::uint8_t left[kBytes] = {};
  for (std::int64_t i = 0; i < row_bytes; i += kBytes) {
    for (int k = 0; k < kBytes; ++k) {
      out[i + k] = left[k] = static_cast<std::uint8_t>(in[i + k] + (left[k] + above[i + k]) / 2);
    }
  }
}

// Of the pixels left, above and above left of each the one nearest to left + above - corner, the first of equals.
template <class V>
SPS_INLINE V paeth_predictor(const V& left, const V& above, const V& corner) {
  const V by_left = above - corner, by_above = left - corner, by_corner = by_left + by_above;
  const V to_left = by_left < 0 ? -by_left : by_left, to_above = by_above < 0 ? -by_above : by_above,
          to_corner = by_corner < 0 ? -by_corner : by_corner;
  const V second = to_above <= to_corner ? above : corner;
  return (to_left <= to_above) & (to_left <= to_corner) ? left : second;
}

// The pixels of one step: row k is k pixels behind row 0.
template <int kBytes>
class Wavefront {
 public:
  static constexpr int kGroup = lanes_of(kBytes);

  // `in` and `out` are row 0's; rows follow at their strides.
  Wavefront(const std::uint8_t* in, std::int64_t in_stride, const std::uint8_t* above, std::uint8_t* out,
            std::int64_t out_stride)
      : in_(in), in_stride_(in_stride), above_(above), out_(out), out_stride_(out_stride) {}

  // Undoes the pixels `step` - k of rows `first` to `last`, the others being outside their rows.
  SPS_INLINE void make(std::int64_t step, int first, int last) {
    Bytes bytes{};
    for (int k = first; k < last; ++k) {
      put_pixel(bytes, k, in_ + k * in_stride_ + (step - k) * kBytes);
    }
    Bytes first_above{};
    if (first == 0) put_pixel(first_above, 0, above_ + step * kBytes);
    const V above =
        a_row_on(__builtin_convertvector(first_above, V), made_, std::make_integer_sequence<int, kLaneCount>{});
    V sum = (__builtin_convertvector(bytes, V) + paeth_predictor(made_, above, corner_)) & 0xff;
    if (first > 0 || last < kTogether) {  // what lies outside a row counts as 0
      for (int lane = 0; lane < kLaneCount; ++lane) {
        if (lane / kGroup < first || lane / kGroup >= last) sum[lane] = 0;
      }
    }
    bytes = __builtin_convertvector(sum, Bytes);
    for (int k = first; k < last; ++k) {
      take_pixel(bytes, k, out_ + k * out_stride_ + (step - k) * kBytes);
    }
    made_ = sum;
    corner_ = above;
  }

 private:
  static constexpr int kLaneCount = kTogether * kGroup;
  using V = Vector<std::int16_t, 2 * kLaneCount>;
  using Bytes = Vector<std::uint8_t, kLaneCount>;
  using Groups = Vector<PixelNumber<kBytes>, kLaneCount>;

  // The pixels of `before` a row further, behind the first of `first`.
  template <int... kLane>
  static SPS_INLINE V a_row_on(const V& first, const V& before, std::integer_sequence<int, kLane...>) {
    return __builtin_shuffle(first, before, V{(kLane < kGroup ? kLane : kLaneCount + kLane - kGroup)...});
  }

  static SPS_INLINE void put_pixel(Bytes& bytes, int k, const std::uint8_t* from) {
    PixelNumber<kBytes> group = 0;
    std::memcpy(&group, from, kBytes);
    Groups groups = (Groups)bytes;
    groups[k] = group;
    bytes = (Bytes)groups;
  }

  static SPS_INLINE void take_pixel(const Bytes& bytes, int k, std::uint8_t* to) {
    const PixelNumber<kBytes> group = ((Groups)bytes)[k];
    std::memcpy(to, &group, kBytes);
  }

  const std::uint8_t* in_;
  std::int64_t in_stride_;
  const std::uint8_t* above_;
  std::uint8_t* out_;
  std::int64_t out_stride_;
  V made_{}, corner_{};  // of the step before
};

// `count` rows, at most kTogether.
template <int kBytes>
void undo_paeth(const std::uint8_t* in, const std::uint8_t* above, const PngRows& image, int count, std::uint8_t* out) {
  Wavefront<kBytes> front(in, 1 + image.row_bytes, above, out, image.row_bytes);
  const std::int64_t columns = image.row_bytes / kBytes, steps = columns + count - 1;
  const auto begins_at = [&](std::int64_t step) {
    return static_cast<int>(std::max<std::int64_t>(step - columns + 1, 0));
  };
  std::int64_t step = 0;
  for (; step < std::min<std::int64_t>(count - 1, steps); ++step) front.make(step, begins_at(step), step + 1);
  if (count == kTogether) {
    for (; step < columns; ++step) front.make(step, 0, kTogether);
  }
  for (; step < steps; ++step) front.make(step, begins_at(step), count);
}

template <int kBytes>
bool undo_filters(const PngRows& image, const std::uint8_t* filtered, std::uint8_t* out) {
  const std::int64_t row_bytes = image.row_bytes, stride = 1 + row_bytes;
  ScratchBuffer<std::uint8_t> nothing;
  std::uint8_t* zeros = nothing.reserve(std::max<std::int64_t>(row_bytes, 1));
  std::fill(zeros, zeros + row_bytes, std::uint8_t{0});
  const std::uint8_t* above = zeros;
  for (std::int32_t row = 0; row < image.rows;) {
    const std::uint8_t* in = filtered + row * stride;
    std::uint8_t* to = out + row * row_bytes;
    int count = 1;
    switch (in[0]) {
      case kNone:
        std::memcpy(to, in + 1, row_bytes);
        break;
      case kSub:
        undo_sub<kBytes>(in + 1, row_bytes, to);
        break;
      case kUp:
        undo_up(in + 1, above, row_bytes, to);
        break;
      case kAverage:
        undo_average<kBytes>(in + 1, above, row_bytes, to);
        break;
      case kPaeth:
        while (count < kTogether && row + count < image.rows && in[count * stride] == kPaeth) ++count;
        undo_paeth<kBytes>(in + 1, above, image, count, to);
        break;
      default:
        return false;
    }
    row += count;
    above = out + (row - 1) * row_bytes;
  }
  return true;
}

}  // namespace

bool unfilter_png(Cpu, const PngRows& image, const std::uint8_t* filtered, std::uint8_t* out) {
  switch (image.pixel_bytes) {
    case 1:
      return undo_filters<1>(image, filtered, out);
    case 2:
      return undo_filters<2>(image, filtered, out);
    case 3:
      return undo_filters<3>(image, filtered, out);
    default:
      return undo_filters<4>(image, filtered, out);
  }
}

void swap_bytes(Cpu, std::int64_t count, std::uint16_t* numbers) {
  SPS_SIMD for (std::int64_t i = 0; i < count; ++i) {
    numbers[i] = static_cast<std::uint16_t>(numbers[i] << 8 | numbers[i] >> 8);
  }
}

}  // namespace spslam
