#include "mesh.h"

#include <fstream>
#include <stdexcept>

namespace {

template <class T>
void put(std::ofstream& file, const T* values, std::size_t count) {
  file.write(reinterpret_cast<const char*>(values), static_cast<std::streamsize>(count * sizeof(T)));
}

}  // namespace

void write_ply(const Mesh& mesh, const std::string& path) {
  std::ofstream file(path, std::ios::binary);
  file << "ply\nformat binary_little_endian 1.0\nelement vertex " << mesh.vertices.size() / 3
       << "\nproperty float x\nproperty float y\nproperty float z\nelement face " << mesh.faces.size() / 3
       << "\nproperty list uchar int vertex_indices\nend_header\n";
  put(file, mesh.vertices.data(), mesh.vertices.size());
  for (std::size_t i = 0; i < mesh.faces.size(); i += 3) {
    const std::uint8_t corners = 3;
    const std::int32_t face[3] = {static_cast<std::int32_t>(mesh.faces[i]),
                                  static_cast<std::int32_t>(mesh.faces[i + 1]),
                                  static_cast<std::int32_t>(mesh.faces[i + 2])};
    put(file, &corners, 1);
    put(file, face, 3);
  }
  if (!file.flush()) throw std::runtime_error(path + ": cannot be written");
}
