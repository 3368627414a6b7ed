# Installs the headers as <prefix>/include/spslam: the public ones, and below them core/ and kernels/, which they
# include. In the tree these two are named from csrc; installed, every name begins with spslam/.
file(REMOVE_RECURSE ${SPSLAM_STAGE})
file(GLOB public RELATIVE ${SPSLAM_SOURCE}/include/spslam ${SPSLAM_SOURCE}/include/spslam/*.h)
file(GLOB inner RELATIVE ${SPSLAM_SOURCE} ${SPSLAM_SOURCE}/core/*.h ${SPSLAM_SOURCE}/kernels/*.h)
list(FILTER inner EXCLUDE REGEX "_launch\\.h$")

function(stage from to)
  file(READ ${from} text)
  string(REGEX REPLACE "#include \"(core|kernels)/" "#include \"spslam/\\1/" text "${text}")
  file(WRITE ${SPSLAM_STAGE}/spslam/${to} "${text}")
endfunction()

foreach(header IN LISTS public)
  stage(${SPSLAM_SOURCE}/include/spslam/${header} ${header})
endforeach()
foreach(header IN LISTS inner)
  stage(${SPSLAM_SOURCE}/${header} ${header})
endforeach()
file(INSTALL ${SPSLAM_STAGE}/spslam DESTINATION ${CMAKE_INSTALL_PREFIX}/${SPSLAM_INCLUDEDIR})
