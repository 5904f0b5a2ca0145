# What is wrong with Rust is said before anything is built, and a compiler is mapped to its Rust target:
# cmake -DFOLDER=<temporary folder> -P test/cargo.cmake
cmake_minimum_required(VERSION 3.16)
include(${CMAKE_CURRENT_LIST_DIR}/../cargo.cmake)
get_filename_component(repository ${CMAKE_CURRENT_LIST_DIR}/../.. REALPATH)

# One call, in a process of its own.
if(DEFINED CALL)
  if(CALL STREQUAL "find")
    axon_find_rust(${SOURCE})
    message(STATUS "cargo ${CARGO}, rustc ${AXON_RUSTC}")
  elseif(CALL STREQUAL "places")
    axon_cargo_places(places)
    message(STATUS "places ${places}.")
  elseif(CALL STREQUAL "map")
    axon_rust_target("${TRIPLE}" "${PROCESSOR}" target)
    message(STATUS "target ${target}.")
  elseif(CALL STREQUAL "target")
    axon_require_target(${RUSTC} ${TARGET} ${SOURCE})
  elseif(CALL STREQUAL "command")
    axon_cargo_build(${RUSTC} ${SOURCE} /build command artefacts)
    list(JOIN command " " command)
    message(STATUS "command: ${command}, artefacts: ${artefacts}.")
  endif()
  return()
endif()

# Expects a call to fail or not, and to say something.
function(expect failure expected call)
  execute_process(
    COMMAND ${CMAKE_COMMAND} -E env --unset=RUSTC --unset=CFLAGS_aarch64_unknown_linux_gnu
      --unset=CARGO_TARGET_AARCH64_UNKNOWN_LINUX_GNU_RUSTFLAGS
      HOME=${FOLDER}/home CARGO_HOME=${cargo_home} "PATH=${path}"
      ${CMAKE_COMMAND} -DCALL=${call} ${ARGN} -P ${CMAKE_CURRENT_LIST_FILE}
    RESULT_VARIABLE status OUTPUT_VARIABLE said ERROR_VARIABLE errors)
  string(REGEX REPLACE "[ \n]+" " " said "${said}${errors}")
  set(failed FALSE)
  if(status)
    set(failed TRUE)
  endif()
  string(FIND "${said}" "${expected}" at)
  if(at EQUAL -1 OR NOT failed STREQUAL failure)
    message(SEND_ERROR "${call} ${ARGN}: expected failure ${failure} and \"${expected}\"; said: ${said}")
  endif()
endfunction()

# A program that says `text` and ends with `status`.
function(make_program file text status)
  file(WRITE ${FOLDER}/made "#!/bin/sh\necho '${text}'\nexit ${status}\n")
  get_filename_component(directory ${file} DIRECTORY)
  get_filename_component(name ${file} NAME)
  file(MAKE_DIRECTORY ${directory})
  file(COPY ${FOLDER}/made DESTINATION ${directory}
    FILE_PERMISSIONS OWNER_READ OWNER_WRITE OWNER_EXECUTE)
  file(RENAME ${directory}/made ${file})
endfunction()

function(make_rust bin cargo rustc)
  make_program(${bin}/cargo "cargo ${cargo} (abcdef012 2024-01-01)" 0)
  make_program(${bin}/rustc "rustc ${rustc} (abcdef012 2024-01-01)" 0)
endfunction()

file(REMOVE_RECURSE ${FOLDER})
file(MAKE_DIRECTORY ${FOLDER}/none ${FOLDER}/source)
file(WRITE ${FOLDER}/source/Cargo.toml "[workspace.package]\nrust-version = \"1.70\"\n")
set(source -DSOURCE=${FOLDER}/source)

# The version is the workspace's, and the README says the same.
axon_rust_needed(${repository} needed)
file(READ ${repository}/rmw_axon/README.md readme)
string(FIND "${readme}" "Rust ${needed} or newer" at)
if(at EQUAL -1)
  message(SEND_ERROR "rmw_axon/README.md does not say \"Rust ${needed} or newer\"")
endif()

set(path ${FOLDER}/none)
# /bin is not among them, which has the distribution's cargo.
set(cargo_home "")
expect(FALSE "places ${FOLDER}/home/.cargo/bin." places)
set(cargo_home ${FOLDER}/home)
expect(FALSE "places ${FOLDER}/home/bin;${FOLDER}/home/.cargo/bin." places)
expect(TRUE "needs Rust 1.70 or newer, and there is no cargo" find ${source})
expect(TRUE "there is no ${FOLDER}/none/Cargo.toml. Clone the whole repository" find -DSOURCE=${FOLDER}/none)

make_rust(${FOLDER}/old 1.69.0 1.69.0)
make_rust(${FOLDER}/half 1.75.0 1.69.0)
make_rust(${FOLDER}/new 1.70.0-nightly 1.100.0)
make_program(${FOLDER}/unset/cargo "no default toolchain is configured" 1)
make_program(${FOLDER}/alone/cargo "cargo 1.75.0 (abcdef012 2024-01-01)" 0)
set(path ${FOLDER}/old)
expect(TRUE "needs Rust 1.70 or newer, and found cargo 1.69.0 (${FOLDER}/old/cargo). Run `rustup update" find ${source})
set(path ${FOLDER}/half)
expect(TRUE "found rustc 1.69.0 (${FOLDER}/half/rustc)" find ${source})
set(path ${FOLDER}/unset)
expect(TRUE "no default toolchain is configured" find ${source})
set(path ${FOLDER}/alone)
expect(TRUE "found ${FOLDER}/alone/cargo but no rustc" find ${source})
set(path ${FOLDER}/new)
expect(FALSE "cargo ${FOLDER}/new/cargo, rustc ${FOLDER}/new/rustc" find ${source})

# Another one is named, or is where rustup puts it.
set(path ${FOLDER}/old)
expect(FALSE "cargo ${FOLDER}/new/cargo, rustc ${FOLDER}/new/rustc" find ${source} -DCARGO=${FOLDER}/new/cargo)
make_rust(${FOLDER}/home/bin 1.80.0 1.80.0)
expect(FALSE "cargo ${FOLDER}/home/bin/cargo, rustc ${FOLDER}/home/bin/rustc" find ${source})

function(expect_target expected triple processor)
  expect(FALSE "target ${expected}." map -DTRIPLE=${triple} -DPROCESSOR=${processor})
endfunction()
expect_target(aarch64-unknown-linux-gnu aarch64-linux-gnu aarch64)
expect_target(aarch64-unknown-linux-gnu aarch64-poky-linux aarch64)
expect_target(aarch64-unknown-linux-gnu "" arm64)
expect_target(aarch64-unknown-linux-musl aarch64-linux-musl aarch64)
expect_target(x86_64-unknown-linux-gnu x86_64-linux-gnu AMD64)
expect_target(armv7-unknown-linux-gnueabihf arm-linux-gnueabihf armv7l)
expect_target(arm-unknown-linux-gnueabihf arm-linux-gnueabihf armv6l)
expect_target(armv7-unknown-linux-gnueabi arm-linux-gnueabi arm)
expect_target(i686-unknown-linux-gnu i586-linux-gnu i586)
expect_target(riscv64gc-unknown-linux-gnu riscv64-unknown-linux-gnu riscv64)
expect_target(powerpc64le-unknown-linux-gnu powerpc64le-linux-gnu ppc64le)
expect(TRUE "CMAKE_SYSTEM_PROCESSOR \"xtensa\". Set AXON_CARGO_TARGET" map -DTRIPLE=xtensa-elf -DPROCESSOR=xtensa)

# rustc prints where a target's libraries would be, whether there are any or not.
make_program(${FOLDER}/bare/rustc ${FOLDER}/bare/lib 0)
make_program(${FOLDER}/full/rustc ${FOLDER}/full/lib 0)
file(WRITE ${FOLDER}/full/lib/libstd-0123456789abcdef.rlib "")
make_program(${FOLDER}/unknown/rustc "error: could not find specification" 1)
set(target ${source} -DTARGET=aarch64-unknown-linux-gnu)
expect(FALSE "" target ${target} -DRUSTC=${FOLDER}/full/rustc)
expect(TRUE "Run `rustup target add aarch64-unknown-linux-gnu`" target ${target} -DRUSTC=${FOLDER}/bare/rustc)
expect(TRUE "has no target aarch64-unknown-linux-gnu" target ${target} -DRUSTC=${FOLDER}/unknown/rustc)

# The whole command line, for this machine and for another.
set(command command ${source} -DRUSTC=${FOLDER}/full/rustc -DCARGO=/cargo)
expect(FALSE "/cargo build --release --locked, artefacts: /build/release." ${command})
expect(FALSE "/cargo build --release --locked --offline, artefacts: /build/release." ${command} -DAXON_CARGO_ARGS=--offline)
list(APPEND command -DCMAKE_C_COMPILER=/bin/a-gcc -DCMAKE_CXX_COMPILER=/bin/a-g++ -DCMAKE_AR=/bin/a-ar
  -DCMAKE_SYSTEM_NAME=Linux)
set(cross -DCMAKE_CROSSCOMPILING=TRUE -DCMAKE_SYSTEM_PROCESSOR=aarch64)
set(built "/cargo build --release --locked --target aarch64-unknown-linux-gnu, artefacts: /build/aarch64-unknown-linux-gnu/release.")
set(tools "CC_aarch64_unknown_linux_gnu=/bin/a-gcc CXX_aarch64_unknown_linux_gnu=/bin/a-g++ AR_aarch64_unknown_linux_gnu=/bin/a-ar CARGO_TARGET_AARCH64_UNKNOWN_LINUX_GNU_LINKER=/bin/a-gcc")
# By the toolchain file's processor, where the compiler does not say more; by name; by the target of a compiler for many.
expect(FALSE "${tools} ${built}" ${command} ${cross})
string(REPLACE aarch64 x86_64 other "${built}")
expect(FALSE "${other}" ${command} ${cross} -DAXON_CARGO_TARGET=x86_64-unknown-linux-gnu)
set(clang -DCMAKE_C_COMPILER_TARGET=aarch64-linux-gnu -DCMAKE_CXX_COMPILER_TARGET=aarch64-linux-gnu)
set(flags "--target=aarch64-linux-gnu --sysroot=/sys")
set(link "-Clink-arg=--target=aarch64-linux-gnu -Clink-arg=--sysroot=/sys")
expect(FALSE
  "CFLAGS_aarch64_unknown_linux_gnu= ${flags} CXXFLAGS_aarch64_unknown_linux_gnu= ${flags} CARGO_TARGET_AARCH64_UNKNOWN_LINUX_GNU_RUSTFLAGS= ${link} ${built}"
  ${command} ${cross} ${clang} -DCMAKE_SYSROOT=/sys)
expect(TRUE "CMAKE_SYSTEM_NAME is \"QNX\"" ${command} ${cross} -DCMAKE_SYSTEM_NAME=QNX)
