# Installs the headers as <prefix>/include/spslam: the public ones and, below them, core/, which they include. In the
# tree core/ is named from csrc; installed, every name begins with spslam/.
file(REMOVE_RECURSE ${SPSLAM_STAGE})
file(GLOB_RECURSE public RELATIVE ${SPSLAM_SOURCE}/include/spslam ${SPSLAM_SOURCE}/include/spslam/*.h)
file(GLOB core RELATIVE ${SPSLAM_SOURCE} ${SPSLAM_SOURCE}/core/*.h)

function(stage from to)
  file(READ ${from} text)
  string(REPLACE "#include \"core/" "#include \"spslam/core/" text "${text}")
  file(WRITE ${SPSLAM_STAGE}/spslam/${to} "${text}")
endfunction()

foreach(header IN LISTS public)
  stage(${SPSLAM_SOURCE}/include/spslam/${header} ${header})
endforeach()
foreach(header IN LISTS core)
  stage(${SPSLAM_SOURCE}/${header} ${header})
endforeach()
file(INSTALL ${SPSLAM_STAGE}/spslam DESTINATION ${CMAKE_INSTALL_PREFIX}/${SPSLAM_INCLUDEDIR})
