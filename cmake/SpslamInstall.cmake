# What C++ projects need: headers, kernel libraries and the package that find_package(Spslam) reads.
include(CMakePackageConfigHelpers)

set(_package_dir ${CMAKE_INSTALL_LIBDIR}/cmake/Spslam)

install(CODE "
  set(SPSLAM_SOURCE \"${CMAKE_CURRENT_SOURCE_DIR}/csrc\")
  set(SPSLAM_STAGE \"${CMAKE_CURRENT_BINARY_DIR}/installed-include\")
  set(SPSLAM_INCLUDEDIR \"${CMAKE_INSTALL_INCLUDEDIR}\")" COMPONENT development)
install(SCRIPT ${CMAKE_CURRENT_LIST_DIR}/install_headers.cmake COMPONENT development)

install(EXPORT SpslamCpuTargets NAMESPACE Spslam:: DESTINATION ${_package_dir} COMPONENT development)
if(SPSLAM_CUDA)
  install(EXPORT SpslamCudaTargets NAMESPACE Spslam:: DESTINATION ${_package_dir} COMPONENT development)
endif()

configure_package_config_file(${CMAKE_CURRENT_LIST_DIR}/SpslamConfig.cmake.in SpslamConfig.cmake
  INSTALL_DESTINATION ${_package_dir} NO_SET_AND_CHECK_MACRO)
# Before 1.0 a minor version may change the headers.
write_basic_package_version_file(SpslamConfigVersion.cmake COMPATIBILITY SameMinorVersion)
install(FILES ${CMAKE_CURRENT_BINARY_DIR}/SpslamConfig.cmake ${CMAKE_CURRENT_BINARY_DIR}/SpslamConfigVersion.cmake
  DESTINATION ${_package_dir} COMPONENT development)
