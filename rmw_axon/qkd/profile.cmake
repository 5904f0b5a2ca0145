# AXON_QKD_ROLE: this host is one of two whose quantum keys a simulator makes.
#
# Installs an axon.toml beside the daemon, which finds it there, and what it names. For tests and demonstrations.

set(AXON_QKD_ROLE "" CACHE STRING
  "Install a profile for SIMULATED quantum keys: 1 for the host that runs the simulator, 2 for the other; empty for none")
set_property(CACHE AXON_QKD_ROLE PROPERTY STRINGS "" 1 2)
if(AXON_QKD_ROLE STREQUAL "")
  return()
endif()
if(NOT AXON_QKD_ROLE MATCHES "^[12]$")
  message(FATAL_ERROR "AXON_QKD_ROLE: read \"${AXON_QKD_ROLE}\", accepted: 1, 2, or nothing for no profile")
endif()

# Certificates and private keys stay out of the source, of the build folder, and of everything that is packed and shared.
if(DEFINED ENV{XDG_DATA_HOME})
  set(data_home $ENV{XDG_DATA_HOME})
else()
  set(data_home $ENV{HOME}/.local/share)
endif()
set(AXON_QKD_MATERIAL ${data_home}/axon/simulated-qkd CACHE PATH
  "Where role 1 keeps the simulator's certificates and keys, and role 2 finds those of host 2")
set(AXON_QKD_ADDRESS 127.0.0.1 CACHE STRING
  "Role 1: the address at which both hosts reach the simulator, which runs on host 1")

message(WARNING
  "AXON_QKD_ROLE=${AXON_QKD_ROLE}: the keys of this profile are SIMULATED. They have seen no quantum channel, and "
  "whoever reads ${AXON_QKD_MATERIAL} can get all of them. For tests and demonstrations only.")

set(profile ${AXON_QKD_MATERIAL}/host-${AXON_QKD_ROLE})
set(simulator ${core_artefacts}/kme-sim)
if(AXON_QKD_ROLE EQUAL 1)
  if(CMAKE_CROSSCOMPILING)
    message(FATAL_ERROR
      "AXON_QKD_ROLE=1 runs the simulator to draw its keys, and this build is for another machine: "
      "build role 1 on its host. Role 2 can be cross-compiled.")
  endif()
  # A call of its own: in one with the core's, the simulator's features would become the daemon's.
  set(build_simulator
    COMMAND ${cargo_build} --package etsi-qkd014 --features sim --bin kme-sim)
endif()
add_custom_target(axon_qkd_profile ALL
  ${build_simulator}
  COMMAND ${CMAKE_CURRENT_LIST_DIR}/make-profile
    ${AXON_QKD_ROLE} ${AXON_QKD_MATERIAL} ${AXON_QKD_ADDRESS} ${simulator}
  WORKING_DIRECTORY ${core_source}
  USES_TERMINAL
  COMMENT "AXON's profile for simulated quantum keys"
  VERBATIM)
# Cargo would wait for the other call anyway.
add_dependencies(axon_qkd_profile axon_core)

set(installed lib/${PROJECT_NAME})
# An axon.toml that somebody wrote for real key managers is not replaced.
install(CODE "
  set(there \"\$ENV{DESTDIR}\${CMAKE_INSTALL_PREFIX}/${installed}/axon.toml\")
  if(EXISTS \"\${there}\")
    file(READ \"\${there}\" text LIMIT 4096)
    if(NOT text MATCHES \"SIMULATED\")
      message(FATAL_ERROR \"\${there} is not one of AXON_QKD_ROLE's: move it away, or build without AXON_QKD_ROLE\")
    endif()
    # CMake keeps a file of the same time, and both hosts' files were made in one second.
    file(REMOVE \"\${there}\")
  endif()
  message(STATUS \"quantum keys are SIMULATED with this installation: \${there}\")"
  COMPONENT axon_qkd_profile)
# With the modes that they have: a private key is its owner's alone.
install(FILES ${profile}/axon.toml DESTINATION ${installed} COMPONENT axon_qkd_profile)
install(DIRECTORY ${profile}/simulated-qkd DESTINATION ${installed} USE_SOURCE_PERMISSIONS
  COMPONENT axon_qkd_profile)
if(AXON_QKD_ROLE EQUAL 1)
  install(DIRECTORY ${AXON_QKD_MATERIAL}/kmes DESTINATION ${installed}/simulated-qkd USE_SOURCE_PERMISSIONS
    COMPONENT axon_qkd_profile)
  install(PROGRAMS ${simulator} DESTINATION ${installed} COMPONENT axon_qkd_profile)
endif()
