# Finds cargo, refuses a Rust that is too old before anything is built, and has cargo build for what CMake builds for.
#
#   CARGO              the cargo to use; by default CARGO_HOME's, ~/.cargo's, that in PATH, or where that is too old
#                      the newest of the packages cargo-1.NN
#   AXON_CARGO_ARGS    more arguments of each `cargo build`: --offline
#   AXON_CARGO_TARGET  the Rust target; by default the machine's own, or the one of CMake's toolchain file

set(AXON_CARGO_ARGS "" CACHE STRING "More arguments of each `cargo build`, separated by semicolons: --offline")
set(AXON_CARGO_TARGET "" CACHE STRING
  "The Rust target of the core, as `rustc --print target-list` spells it; empty for that of CMake's compiler")

set(axon_another_cargo "Another cargo is named by -DCARGO=/path/to/cargo.")

# The folder of the crates: axon/ in a source package, which has all of them, and the repository otherwise.
function(axon_core_source package result)
  if(EXISTS ${package}/axon/Cargo.toml)
    get_filename_component(source ${package}/axon REALPATH)
  else()
    get_filename_component(source ${package}/.. REALPATH)
  endif()
  set(${result} ${source} PARENT_SCOPE)
endfunction()

# The workspace's rust-version, the only place that says it.
function(axon_rust_needed source result)
  set(manifest ${source}/Cargo.toml)
  if(NOT EXISTS ${manifest})
    message(FATAL_ERROR
      "rmw_axon builds AXON's core from the repository that it is part of, and there is no ${manifest}. "
      "Clone the whole repository into the workspace.")
  endif()
  file(STRINGS ${manifest} lines REGEX "^rust-version *= *\"[0-9.]+\"")
  if(NOT lines MATCHES "\"([0-9.]+)\"")
    message(FATAL_ERROR "${manifest} has no rust-version")
  endif()
  set(${result} ${CMAKE_MATCH_1} PARENT_SCOPE)
endfunction()

# Sets `result` to the version of Rust that a program is of, or to nothing where it does not say. What it said
# instead is in `said`. Run in `source`, where a rust-toolchain file or `rustup override` may choose the toolchain.
function(axon_rust_version program source result said)
  execute_process(
    COMMAND ${program} --version WORKING_DIRECTORY ${source}
    RESULT_VARIABLE status OUTPUT_VARIABLE output ERROR_VARIABLE errors)
  set(version "")
  if(status EQUAL 0 AND output MATCHES "([0-9]+\\.[0-9]+\\.[0-9]+)")
    set(version ${CMAKE_MATCH_1})
  endif()
  set(${result} "${version}" PARENT_SCOPE)
  set(${said} "(${status}): ${output}${errors}" PARENT_SCOPE)
endfunction()

# Fails where `program --version` is not that of Rust `needed` or newer.
function(axon_require_rust program needed source)
  get_filename_component(name ${program} NAME)
  axon_rust_version(${program} ${source} version said)
  if(NOT version)
    message(FATAL_ERROR
      "rmw_axon needs Rust ${needed} or newer, and `${program} --version` fails ${said}\n"
      "Run `rustup default stable`, or install Rust from https://rustup.rs. ${axon_another_cargo}")
  endif()
  if(version VERSION_LESS needed)
    message(FATAL_ERROR
      "rmw_axon needs Rust ${needed} or newer, and found ${name} ${version} (${program}). "
      "Run `rustup update stable`, or install Rust from https://rustup.rs: it is preferred to an older cargo of "
      "the distribution. Where the distribution has them, its packages cargo-1.NN and rustc-1.NN of such a version "
      "are found too. ${axon_another_cargo}")
  endif()
endfunction()

# Ubuntu's packages cargo-1.NN and rustc-1.NN: sets `cargo` and `rustc` to the newest pair of Rust `needed` or newer,
# or to nothing. The folder of each version is looked at first: on some releases of Ubuntu /usr/bin/cargo-1.NN runs
# the cargo of the default version (https://bugs.launchpad.net/bugs/2100266).
function(axon_versioned_rust needed source cargo rustc)
  if(NOT DEFINED AXON_RUST_PACKAGES)
    set(AXON_RUST_PACKAGES /usr/lib)
  endif()
  file(GLOB cargos ${AXON_RUST_PACKAGES}/rust-1.*/bin/cargo)
  string(REPLACE ":" ";" path "$ENV{PATH}")
  foreach(folder IN LISTS path)
    file(GLOB there ${folder}/cargo-1.*)
    list(APPEND cargos ${there})
  endforeach()
  set(newest 0)
  set(found_cargo "")
  set(found_rustc "")
  foreach(candidate IN LISTS cargos)
    get_filename_component(folder ${candidate} DIRECTORY)
    get_filename_component(name ${candidate} NAME)
    string(REPLACE cargo rustc beside ${name})
    if(EXISTS ${folder}/${beside})
      axon_rust_version(${candidate} ${source} version said)
      axon_rust_version(${folder}/${beside} ${source} of_rustc said)
      if(version AND NOT version VERSION_LESS needed AND NOT of_rustc VERSION_LESS needed
          AND version VERSION_GREATER newest)
        set(newest ${version})
        set(found_cargo ${candidate})
        set(found_rustc ${folder}/${beside})
      endif()
    endif()
  endforeach()
  set(${cargo} "${found_cargo}" PARENT_SCOPE)
  set(${rustc} "${found_rustc}" PARENT_SCOPE)
endfunction()

# Where rustup installs cargo. Without CARGO_HOME its /bin would be the distribution's.
function(axon_cargo_places result)
  set(places "")
  if(NOT "$ENV{CARGO_HOME}" STREQUAL "")
    list(APPEND places $ENV{CARGO_HOME}/bin)
  endif()
  if(NOT "$ENV{HOME}" STREQUAL "")
    list(APPEND places $ENV{HOME}/.cargo/bin)
  endif()
  set(${result} "${places}" PARENT_SCOPE)
endfunction()

# Finds cargo and the rustc that it runs; sets CARGO and AXON_RUSTC. With -DCARGO or RUSTC in the environment nothing
# else is looked for.
macro(axon_find_rust source)
  axon_rust_needed(${source} axon_needed)
  axon_cargo_places(axon_places)
  set(axon_is_named FALSE)
  if(CARGO OR NOT "$ENV{RUSTC}" STREQUAL "")
    set(axon_is_named TRUE)
  endif()
  find_program(CARGO cargo HINTS ${axon_places} NO_CMAKE_FIND_ROOT_PATH)
  set(axon_cargo_found ${CARGO})
  # Not kept in the cache until it fits: the next run is to find what was installed meanwhile.
  unset(CARGO CACHE)
  set(AXON_RUSTC "")
  if(NOT axon_is_named)
    set(axon_version "")
    if(axon_cargo_found)
      axon_rust_version(${axon_cargo_found} ${source} axon_version axon_said)
    endif()
    if(NOT axon_version OR axon_version VERSION_LESS axon_needed)
      axon_versioned_rust(${axon_needed} ${source} axon_cargo_versioned AXON_RUSTC)
      if(axon_cargo_versioned)
        set(axon_cargo_found ${axon_cargo_versioned})
      endif()
    endif()
  endif()
  if(NOT axon_cargo_found)
    message(FATAL_ERROR
      "rmw_axon needs Rust ${axon_needed} or newer, and there is no cargo in CARGO_HOME, in ~/.cargo and in PATH. "
      "Install Rust from https://rustup.rs. ${axon_another_cargo}")
  endif()
  axon_require_rust(${axon_cargo_found} ${axon_needed} ${source})
  axon_find_rustc(${axon_cargo_found})
  if(NOT AXON_RUSTC)
    message(FATAL_ERROR
      "rmw_axon needs Rust ${axon_needed} or newer, and found ${axon_cargo_found} but no rustc. "
      "Install Rust from https://rustup.rs. ${axon_another_cargo}")
  endif()
  axon_require_rust(${AXON_RUSTC} ${axon_needed} ${source})
  set(CARGO ${axon_cargo_found} CACHE FILEPATH "The cargo that builds AXON's core")
endmacro()

# Sets AXON_RUSTC: that of the environment, that which has the version of a cargo-1.NN in its name, or that beside cargo.
macro(axon_find_rustc cargo)
  get_filename_component(axon_cargo_bin ${cargo} DIRECTORY)
  get_filename_component(axon_rustc_name ${cargo} NAME)
  string(REPLACE cargo rustc axon_rustc_name "${axon_rustc_name}")
  if(NOT "$ENV{RUSTC}" STREQUAL "")
    set(AXON_RUSTC $ENV{RUSTC})
  elseif(NOT AXON_RUSTC)
    find_program(axon_rustc_found ${axon_rustc_name} rustc HINTS ${axon_cargo_bin} NO_CMAKE_FIND_ROOT_PATH)
    set(AXON_RUSTC ${axon_rustc_found})
    unset(axon_rustc_found CACHE)
  endif()
endmacro()

# The Rust target for a compiler's triple, as `gcc -dumpmachine` says it, and CMAKE_SYSTEM_PROCESSOR.
function(axon_rust_target triple processor result)
  string(REGEX MATCH "^[^-]+" machine "${triple}")
  if(NOT machine)
    set(machine "${processor}")
  endif()
  string(TOLOWER "${machine}" machine)
  string(REGEX MATCH "(gnu|musl)[a-z0-9]*$" abi "${triple}")
  if(NOT abi)
    set(abi gnu)
  endif()
  if(machine MATCHES "^(aarch64|arm64)$")
    set(machine aarch64)
  elseif(machine MATCHES "^(x86_64|amd64)$")
    set(machine x86_64)
  elseif(machine MATCHES "^arm")
    # A compiler's name says "arm" of all 32-bit ones.
    if("${machine} ${processor}" MATCHES "armv6")
      set(machine arm)
    else()
      set(machine armv7)
    endif()
    if(NOT abi MATCHES "eabi")
      string(APPEND abi eabihf)
    endif()
  elseif(machine MATCHES "^i[3-6]86$")
    set(machine i686)
  elseif(machine STREQUAL "riscv64")
    set(machine riscv64gc)
  elseif(machine MATCHES "^(powerpc64le|ppc64le)$")
    set(machine powerpc64le)
  elseif(NOT machine MATCHES "^(s390x|loongarch64)$")
    message(FATAL_ERROR
      "there is no Rust target known for compiler \"${triple}\", CMAKE_SYSTEM_PROCESSOR \"${processor}\". "
      "Set AXON_CARGO_TARGET to one of `rustc --print target-list`.")
  endif()
  set(${result} ${machine}-unknown-linux-${abi} PARENT_SCOPE)
endfunction()

# Fails where `rustc` cannot compile for `target`.
function(axon_require_target rustc target source)
  execute_process(
    COMMAND ${rustc} --print target-libdir --target ${target} WORKING_DIRECTORY ${source}
    RESULT_VARIABLE status OUTPUT_VARIABLE libraries ERROR_VARIABLE errors OUTPUT_STRIP_TRAILING_WHITESPACE)
  if(NOT status EQUAL 0)
    message(FATAL_ERROR
      "${rustc} has no target ${target}: ${errors}\n"
      "Set AXON_CARGO_TARGET to one of `rustc --print target-list`.")
  endif()
  file(GLOB std ${libraries}/libstd-*)
  if(NOT std)
    message(FATAL_ERROR
      "Rust's standard library for ${target} is not installed (${libraries}). Run `rustup target add ${target}`, "
      "or set AXON_CARGO_TARGET to the target that is meant.")
  endif()
endfunction()

# Sets `command` to the start of a cargo build's command line, and `artefacts` to the folder of what it makes.
function(axon_cargo_build rustc source build command artefacts)
  # What is set for C++ packages is not for aws-lc and zstd.
  # colcon takes what cargo says of its progress, on stderr, for something to be shown.
  set(env --unset=CFLAGS --unset=CXXFLAGS CARGO_TERM_QUIET=true CARGO_TARGET_DIR=${build})
  # Cargo runs the rustc in PATH, which is not the one that goes with a cargo of another place.
  get_filename_component(cargo_bin ${CARGO} DIRECTORY)
  get_filename_component(cargo_name ${CARGO} NAME)
  if(cargo_bin MATCHES "/rust-1[.][0-9]+/bin$" OR cargo_name MATCHES "^cargo-1[.]")
    list(APPEND env RUSTC=${rustc})
  endif()
  # A source package has all crates: nothing is read from the builder's home, which may not exist, or written there.
  if(EXISTS ${source}/vendor)
    list(APPEND env CARGO_HOME=${build}/cargo-home)
  endif()
  set(arguments build --release --locked ${AXON_CARGO_ARGS})
  set(out ${build}/release)
  set(target "${AXON_CARGO_TARGET}")
  set(machine "${CMAKE_CXX_COMPILER_TARGET}")
  if(NOT target AND (CMAKE_CROSSCOMPILING OR machine))
    if(NOT CMAKE_SYSTEM_NAME STREQUAL "Linux")
      message(FATAL_ERROR "rmw_axon is for Linux, and CMAKE_SYSTEM_NAME is \"${CMAKE_SYSTEM_NAME}\"")
    endif()
    if(NOT machine)
      execute_process(COMMAND ${CMAKE_CXX_COMPILER} -dumpmachine
        OUTPUT_VARIABLE machine ERROR_QUIET OUTPUT_STRIP_TRAILING_WHITESPACE)
    endif()
    axon_rust_target("${machine}" "${CMAKE_SYSTEM_PROCESSOR}" target)
  endif()
  if(target)
    axon_require_target(${rustc} ${target} ${source})
    message(STATUS "AXON's core is built for ${target}")
    list(APPEND arguments --target ${target})
    set(out ${build}/${target}/release)
    string(REPLACE "-" "_" lower ${target})
    string(TOUPPER ${lower} upper)
    set(flags "")
    set(rustflags "$ENV{CARGO_TARGET_${upper}_RUSTFLAGS}")
    foreach(flag IN ITEMS "--target=${CMAKE_C_COMPILER_TARGET}" "--sysroot=${CMAKE_SYSROOT}")
      if(NOT flag MATCHES "=$")
        string(APPEND flags " ${flag}")
        string(APPEND rustflags " -Clink-arg=${flag}")
      endif()
    endforeach()
    # Those without a target are for the programs that run while the core is built.
    list(APPEND env --unset=CC --unset=CXX --unset=AR --unset=LDFLAGS
      CC_${lower}=${CMAKE_C_COMPILER}
      CXX_${lower}=${CMAKE_CXX_COMPILER}
      AR_${lower}=${CMAKE_AR}
      CARGO_TARGET_${upper}_LINKER=${CMAKE_C_COMPILER})
    if(flags)
      list(APPEND env
        "CFLAGS_${lower}=$ENV{CFLAGS_${lower}}${flags}"
        "CXXFLAGS_${lower}=$ENV{CXXFLAGS_${lower}}${flags}"
        "CARGO_TARGET_${upper}_RUSTFLAGS=${rustflags}")
    endif()
  endif()
  set(${command} ${CMAKE_COMMAND} -E env ${env} ${CARGO} ${arguments} PARENT_SCOPE)
  set(${artefacts} ${out} PARENT_SCOPE)
endfunction()

# The core: one cargo call makes the static library that is linked in and the daemon beside it. Adds the target
# axon_core; sets core_library and core_daemon, cargo_build as axon_cargo_build does, and core_artefacts.
function(axon_add_core rustc source build)
  axon_cargo_build(${rustc} ${source} ${build} cargo_build core_artefacts)
  set(core_library ${core_artefacts}/librmw_axon_core.a)
  set(core_daemon ${core_artefacts}/axon_daemon)
  # Cargo knows best what is out of date: it is asked every time, and has nothing to do mostly.
  add_custom_target(axon_core ALL
    COMMAND ${cargo_build} --package rmw-axon-core --package axon-daemon --lib --bin axon_daemon
    WORKING_DIRECTORY ${source}
    BYPRODUCTS ${core_library} ${core_daemon}
    USES_TERMINAL
    COMMENT "AXON's core: cargo builds it, which takes minutes the first time"
    VERBATIM)
  foreach(name IN ITEMS core_library core_daemon core_artefacts cargo_build)
    set(${name} "${${name}}" PARENT_SCOPE)
  endforeach()
endfunction()
