//! The C interface: that the header is the code's, and a C program that uses every function, wrongly
//! too, built by plain `cc` and run as it is, under valgrind, and under AddressSanitizer.

#[path = "support/c_program.rs"]
mod c_program;
#[path = "../daemon/tests/support/skip.rs"]
mod skip;

use std::{
    collections::BTreeSet,
    ffi::OsStr,
    fs,
    path::{Path, PathBuf},
    process::Command,
};

use c_program::{SYSTEM, WARNINGS, library, path, run};
use skip::skip;

fn files(directory: &str, extension: &str) -> Vec<PathBuf> {
    let mut files = Vec::new();
    add_files(&path(directory), OsStr::new(extension), &mut files);
    files.sort();
    assert!(!files.is_empty());
    files
}

fn add_files(directory: &Path, extension: &OsStr, files: &mut Vec<PathBuf>) {
    for entry in fs::read_dir(directory).unwrap() {
        let path = entry.unwrap().path();
        if path.is_dir() {
            add_files(&path, extension, files);
        } else if path.extension() == Some(extension) {
            files.push(path);
        }
    }
}

/// Returns whether a program runs. Tests that need a missing program are skipped.
fn has(program: &str) -> bool {
    let found = Command::new(program).arg("--version").output().is_ok_and(|o| o.status.success());
    if !found {
        skip(format_args!("{program} is not installed"));
    }
    found
}

/// Builds the test program with these additional flags.
fn build(directory: &Path, flags: &[&str]) -> PathBuf {
    let program = directory.join("ffi");
    let mut cc = Command::new("cc");
    cc.args(["-std=c99", "-D_GNU_SOURCE"]).args(WARNINGS).args(flags);
    cc.arg("-I").arg(path("include")).args(files("tests/ffi", "c"));
    cc.arg(library("libaxon_c.a")).args(SYSTEM).arg("-o").arg(&program);
    run(&mut cc);
    program
}

/// Returns the command of a program whose sessions are in one process, without a daemon.
fn alone(program: impl AsRef<OsStr>) -> Command {
    let mut command = Command::new(program);
    let ours = |name: &str| name.starts_with("AXON_") || name.starts_with("ROS_");
    for (name, _) in std::env::vars().filter(|(name, _)| ours(name)) {
        command.env_remove(name);
    }
    command.env("AXON_DAEMON", "off");
    command
}

/// The header equals the one that cbindgen generates from the code. `WRITE_HEADER=1` in the environment writes it.
#[test]
fn the_header_is_the_codes() {
    let config = cbindgen::Config::from_file(path("cbindgen.toml")).unwrap();
    // It reads the modules that this one names, too.
    let builder = cbindgen::Builder::new().with_config(config).with_src(path("src/ffi/mod.rs"));
    let mut header = Vec::new();
    builder.generate().unwrap().write(&mut header);
    let header = String::from_utf8(header).unwrap();
    for name in exported() {
        let declared = header.matches(&format!("{name}(")).count();
        assert_eq!(declared, 1, "times that the header declares {name}");
    }
    let checked_in = path("include/axon.h");
    if std::env::var_os("WRITE_HEADER").is_some() {
        fs::write(&checked_in, &header).unwrap();
    }
    let there = fs::read_to_string(&checked_in).unwrap_or_default();
    assert!(
        there == header,
        "include/axon.h is not what src/ffi says: WRITE_HEADER=1 cargo test -p axon-transport --test ffi"
    );
}

#[test]
fn the_header_is_plain_c_and_plain_cpp() {
    let directory = tempfile::tempdir().unwrap();
    let cases = [("cc", "-std=c99", "header.c"), ("c++", "-std=c++17", "header.cpp")];
    for (compiler, standard, name) in cases {
        let source = directory.path().join(name);
        // Twice: it guards itself.
        fs::write(&source, "#include <axon.h>\n#include <axon.h>\nint main(void);\n").unwrap();
        let mut compile = Command::new(compiler);
        compile.args([standard, "-fsyntax-only"]).args(WARNINGS).arg("-I").arg(path("include"));
        run(compile.arg(source));
    }
}

/// Returns the names of the functions that the library has for C.
fn exported() -> Vec<String> {
    functions().into_iter().map(|(name, _)| name).collect()
}

/// Returns the same functions, each with its source.
fn functions() -> Vec<(String, String)> {
    let mut functions = Vec::new();
    for file in files("src/ffi", "rs") {
        let text = fs::read_to_string(file).unwrap();
        for after in text.split("#[unsafe(no_mangle)]\n").skip(1) {
            let source = after.split("\n}\n").next().unwrap().to_owned();
            let declared = source.split("fn ").nth(1).unwrap();
            functions.push((declared.split('(').next().unwrap().to_owned(), source));
        }
    }
    functions
}

/// The tests of `guarded` itself show that it catches panics.
#[test]
fn no_function_lets_a_panic_through() {
    // These functions only look something up; the first must be able to do so in a signal handler.
    let bare = ["guard_trigger", "policy_name", "abi", "last_error"]
        .map(|name| format!("axon_session_{name}"));
    let open = functions().into_iter().filter(|(_, source)| !source.contains("guarded(||"));
    let open: BTreeSet<String> = open.map(|(name, _)| name).collect();
    assert_eq!(open, BTreeSet::from(bare));
}

#[test]
fn the_test_program_uses_every_function() {
    let sources: Vec<String> =
        files("tests/ffi", "c").iter().map(|file| fs::read_to_string(file).unwrap()).collect();
    let unused: Vec<String> = exported()
        .into_iter()
        .filter(|name| !sources.iter().any(|source| source.contains(&format!("{name}("))))
        .collect();
    assert!(exported().len() > 30 && unused.is_empty(), "not used: {unused:?}");
}

/// The file is the one that `cargo xtask install-c` fills in and installs.
#[test]
fn the_pkg_config_file_says_how_to_build() {
    if !has("pkg-config") {
        return;
    }
    let directory = tempfile::tempdir().unwrap();
    let template = fs::read_to_string(path("axon-transport.pc.in")).unwrap();
    let file = template.replace("@prefix@", "/opt/axon").replace("@version@", "1.2.3");
    fs::write(directory.path().join("axon-transport.pc"), file).unwrap();
    let ask = |option: &str| {
        let mut command = Command::new("pkg-config");
        command.env("PKG_CONFIG_PATH", directory.path());
        run(command.args(["axon-transport", option])).trim().to_owned()
    };
    assert_eq!(ask("--cflags"), "-I/opt/axon/include");
    assert_eq!(ask("--libs"), "-L/opt/axon/lib -laxon_transport");
    assert_eq!(ask("--modversion"), "1.2.3");
    assert_eq!(ask("--variable=daemon"), "/opt/axon/bin/axon_daemon");
}

#[test]
fn a_c_program_uses_every_function() {
    let directory = tempfile::tempdir().unwrap();
    run(&mut alone(build(directory.path(), &[])));
}

#[test]
fn a_c_program_uses_every_function_under_address_sanitizer() {
    let directory = tempfile::tempdir().unwrap();
    let probe = directory.path().join("probe.c");
    fs::write(&probe, "int main(void) { return 0; }\n").unwrap();
    let mut cc = Command::new("cc");
    cc.arg("-fsanitize=address").arg(&probe).arg("-o").arg(directory.path().join("probe"));
    if !cc.output().is_ok_and(|output| output.status.success()) {
        return skip("cc has no AddressSanitizer");
    }
    let sanitized = ["-fsanitize=address", "-fno-omit-frame-pointer", "-DFORKS=0"];
    let program = build(directory.path(), &sanitized);
    run(&mut alone(program));
}

#[test]
fn a_c_program_uses_every_function_under_valgrind() {
    if !has("valgrind") {
        return;
    }
    let directory = tempfile::tempdir().unwrap();
    let program = build(directory.path(), &[]);
    let mut valgrind = alone("valgrind");
    // Valgrind tracks the address space, too: unused address space takes most of the time.
    valgrind.envs([("AXON_RING_BUFFER_SIZE_MB", "1"), ("AXON_MAX_MESSAGE_MB", "1")]);
    // A thread that waits for one that does not run gives way to it.
    valgrind.args(["--quiet", "--fair-sched=try", "--error-exitcode=99", "--leak-check=full"]);
    valgrind.args(["--errors-for-leak-kinds=definite", "--show-leak-kinds=definite"]);
    let known = path("tests/ffi/valgrind.supp");
    run(valgrind.arg(format!("--suppressions={}", known.display())).arg(program));
}
