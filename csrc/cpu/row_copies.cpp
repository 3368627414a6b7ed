#include "spslam/row_copies.h"

#include <cstring>

namespace spslam {

template <>
void copy_rows<Cpu>(Cpu, const RowCopy* copies, int count) {
  for (int i = 0; i < count; ++i) {
    if (copies[i].bytes != 0) std::memcpy(copies[i].to, copies[i].from, copies[i].bytes);
  }
}

}  // namespace spslam
