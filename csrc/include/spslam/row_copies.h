// Copies within the memory of a device, many in one call.
#pragma once

#include <cstddef>

#include "core/device.h"

namespace spslam {

// `bytes` from one place to another; the two don't overlap.
struct RowCopy {
  void* to;
  const void* from;
  std::size_t bytes;
};

constexpr int kMaxRowCopies = 8;  // of a call

// In any order: no copy may read or write what another one writes.
template <class Device>
void copy_rows(Device device, const RowCopy* copies, int count);

}  // namespace spslam
