//! Runs the C programs of axon-transport's README as processes of one host.

#[path = "../../tests/support/c_program.rs"]
mod c_program;
#[path = "support/kept.rs"]
mod kept;

use std::{fs, path::Path, process::Command, time::Duration};

use c_program::{SYSTEM, WARNINGS, library, path, run};
use kept::Kept;

#[test]
fn the_examples_are_built_by_plain_cc_and_meet() {
    let directory = tempfile::tempdir().unwrap();
    let readme = fs::read_to_string(path("README.md")).unwrap();
    let build = |name: &str| {
        let source = path("examples/c").join(name).with_extension("c");
        let text = fs::read_to_string(&source).unwrap();
        assert!(
            readme.contains(&format!("```c\n{text}```\n")),
            "the README shows another {name}.c"
        );
        let program = directory.path().join(name);
        let mut cc = Command::new("cc");
        cc.args(WARNINGS).arg(source).arg("-I").arg(path("include"));
        run(cc.arg(library("libaxon_c.a")).args(SYSTEM).arg("-o").arg(&program));
        program
    };
    let there = |program: &Path| {
        let mut command = Command::new(program);
        let ours = |name: &str| name.starts_with("AXON_") || name.starts_with("ROS_");
        for (name, _) in std::env::vars().filter(|(name, _)| ours(name)) {
            command.env_remove(name);
        }
        command.env("AXON_DAEMON", "require").env("AXON_BIND_ADDRS", "127.0.0.1");
        command.env("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST");
        command.env("AXON_RUNTIME_DIR", directory.path());
        command
    };
    let (talker, listener, service) = (build("talker"), build("listener"), build("service"));
    let daemon = Path::new(env!("CARGO_BIN_EXE_axon_daemon"));
    let _daemon = Kept(there(daemon).env_remove("AXON_DAEMON").spawn().unwrap());
    // Wait until the daemon has its address.
    while !directory.path().join("axon-0.sock").exists() {
        std::thread::sleep(Duration::from_millis(10));
    }
    let _talker = Kept(there(&talker).spawn().unwrap());
    let heard = run(&mut there(&listener));
    let numbers: Vec<u32> = heard
        .lines()
        .map(|line| line.strip_prefix("heard hello ").unwrap().parse().unwrap())
        .collect();
    assert!(numbers.len() == 3 && numbers.windows(2).all(|pair| pair[0] < pair[1]), "{heard}");
    let _service = Kept(there(&service).spawn().unwrap());
    assert_eq!(run(there(&service).arg("a question")), "A QUESTION\n");
}
