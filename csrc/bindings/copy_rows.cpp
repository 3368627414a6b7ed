// Rows of tables overwritten, many in one call: a frame that is stored is a handful of copies, each a few microseconds.
#include "bindings/common.h"
#include "spslam/row_copies.h"

namespace spslam::bindings {
namespace {

constexpr char kName[] = "copy_rows_";

bool is_beside(const Tensor& tensor, const Tensor& other) {
  return tensor.is_cpu() == other.is_cpu() && tensor.get_device_index() == other.get_device_index();
}

// What a copy to one row is; the tensors must outlive its launch.
RowCopy row_copy(const Tensor& table, std::int64_t row, const Tensor& value) {
  SPS_CHECK(table.dim() == value.dim() + 1 && table.is_contiguous() && table.scalar_type() == value.scalar_type(),
            kName, ": each table must be contiguous, of the dtype of its value and with one more axis");
  SPS_CHECK(row >= 0 && row < table.size(0), kName, ": rows must be in [0, ", table.size(0), "), got ", row);
  for (std::int64_t axis = 0; axis < value.dim(); ++axis) {
    SPS_CHECK(table.size(axis + 1) == value.size(axis), kName, ": each value must have the shape of its table's rows");
  }
  const std::size_t bytes = static_cast<std::size_t>(value.numel()) * value.element_size();
  return {static_cast<char*>(table.mutable_data_ptr()) + static_cast<std::size_t>(row) * bytes, value.const_data_ptr(),
          bytes};
}

bool overlap(const void* one, std::size_t bytes, const void* other, std::size_t other_bytes) {
  const auto begin = reinterpret_cast<std::uintptr_t>(one), other_begin = reinterpret_cast<std::uintptr_t>(other);
  return begin < other_begin + other_bytes && other_begin < begin + bytes;
}

// Copies that are made together as long as the result is that of one after the other.
class CopyBatch {
 public:
  explicit CopyBatch(const Context& context) : context_(context) {}

  void add(const RowCopy& copy) {
    if (count_ == kMaxRowCopies || needs_earlier(copy)) flush();
    copies_[count_++] = copy;
  }

  void flush() {
    spslam::copy_rows(context_, copies_, count_);
    count_ = 0;
  }

 private:
  bool needs_earlier(const RowCopy& copy) const {
    for (int i = 0; i < count_; ++i) {
      const RowCopy& earlier = copies_[i];
      if (overlap(copy.to, copy.bytes, earlier.to, earlier.bytes) ||
          overlap(copy.from, copy.bytes, earlier.to, earlier.bytes) ||
          overlap(copy.to, copy.bytes, earlier.from, earlier.bytes)) {
        return true;
      }
    }
    return false;
  }

  const Context& context_;
  RowCopy copies_[kMaxRowCopies];
  int count_ = 0;
};

void copy_rows(std::vector<Tensor> tables, std::vector<std::int64_t> rows, std::vector<Tensor> values) {
  SPS_CHECK(tables.size() == rows.size() && tables.size() == values.size(), kName,
            ": tables, rows and values must be as many");
  if (tables.empty()) return;
  for (std::size_t i = 0; i < tables.size(); ++i) {
    SPS_CHECK(is_beside(tables[i], tables[0]) && is_beside(values[i], tables[0]), kName,
              ": all tensors must be on one device");
  }
  DeviceScope scope(tables[0]);
  values = all_contiguous(values);
  CopyBatch batch(scope.context);
  for (std::size_t i = 0; i < tables.size(); ++i) {
    RowCopy copy = row_copy(tables[i], rows[i], values[i]);
    if (copy.from != copy.to && overlap(copy.from, copy.bytes, copy.to, copy.bytes)) {
      values[i] = torch::stable::clone(values[i]);
      copy.from = values[i].const_data_ptr();
    }
    batch.add(copy);
  }
  batch.flush();
}

}  // namespace

#ifndef SPS_CUDA
STABLE_TORCH_LIBRARY_FRAGMENT(spslam, m) {
  m.def("copy_rows_(Tensor(a!)[] tables, int[] rows, Tensor[] values) -> ()");
}
#endif

SPS_LIBRARY_IMPL(m) {
  m.impl("copy_rows_", TORCH_BOX(&copy_rows));
}

}  // namespace spslam::bindings
