// The filters of a PNG's rows undone, which is what is left of decoding it once its data are inflated. On the host
// alone, by the thread that calls: images are read there, several at a time.
#pragma once

#include <cstdint>

#include "core/device.h"

namespace spslam {

// An image that is not interlaced, of whole bytes per pixel.
struct PngRows {
  std::int32_t rows;
  std::int64_t row_bytes;    // without the filter's number
  std::int32_t pixel_bytes;  // from 1 to 4; a row has whole pixels
};

// Undoes the filters (PNG specification, section 9) of `filtered` [rows, 1 + row_bytes], each row behind the number of
// its filter, and writes `out` [rows, row_bytes]. Returns false, with `out` written in part, where a number is none.
bool unfilter_png(Cpu device, const PngRows& image, const std::uint8_t* filtered, std::uint8_t* out);

// Exchanges the bytes of `count` numbers of 16 bits, which a PNG has in network order.
void swap_bytes(Cpu device, std::int64_t count, std::uint16_t* numbers);

}  // namespace spslam
