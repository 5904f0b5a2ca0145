//! Does what each README says, in a project outside of the workspace, and runs its programs.

use std::fs;
use std::io::{BufRead, BufReader};
use std::net::TcpListener;
use std::os::unix::fs::symlink;
use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};

use crate::checkout::installed;
use crate::project::Project;
use crate::readme::Readme;
use crate::support::{Kept, alone, run, target, with_daemon};

/// A project with a program for each `rust` block of the README, built. `None` without a registry.
fn built(name: &str) -> Option<Vec<PathBuf>> {
    let readme = Readme::of(name);
    let project = Project::new(&format!("readme-of-{name}"));
    for arguments in readme.adds() {
        project.add(&arguments)?;
    }
    let mut runnable = Vec::new();
    for program in &readme.programs {
        // The name says where it is from, and is in no other project: all share a target directory.
        let bin = program.place.replace(", ", "-readme-").replace(' ', "-");
        project.write(&format!("src/bin/{bin}.rs"), &program.text);
        if program.has_main {
            runnable.push(target().join("debug").join(&bin));
        }
    }
    run(&mut project.cargo(&["build", "--bins"]));
    Some(runnable)
}

/// A program with nothing of AXON or ROS 2 in its environment, in an empty directory.
struct Place(tempfile::TempDir);

impl Place {
    fn new() -> Self {
        Self(tempfile::tempdir().expect("a directory"))
    }

    fn command(&self, program: &Path) -> Command {
        let mut command = alone(program);
        command.current_dir(self.0.path());
        command
    }

    /// The same, with a daemon.
    fn with_daemon(&self, program: &Path) -> Command {
        let mut command = with_daemon(program, self.0.path());
        command.current_dir(self.0.path());
        command
    }
}

/// What `kme-sim init` prints for an SAE.
fn environment(printed: &str, sae: &str) -> Vec<(String, String)> {
    let (_, rest) = printed.split_once(&format!("# {sae}\n")).expect("the SAE");
    let lines = rest.lines().map_while(|line| line.strip_prefix("export ")?.split_once('='));
    lines.map(|(name, value)| (name.to_owned(), value.trim_matches('\'').to_owned())).collect()
}

#[test]
#[ignore = "builds all that etsi-qkd014 depends on"]
fn the_readme_of_etsi_qkd014_works_as_written() {
    let Some(programs) = built("etsi-qkd014") else { return };
    assert_ne!(programs.len(), 0);
    let commands = Readme::of("etsi-qkd014").commands;
    let told = |line: &str| assert!(commands.iter().any(|one| one == line), "{line}: {commands:?}");
    told("cargo install --locked --path axon/etsi-qkd014 --features sim");
    told("kme-sim init certs");
    told("kme-sim run certs");

    let install = ["--path", "axon/etsi-qkd014", "--features", "sim"];
    let Some(kme_sim) = installed(&install) else { return };
    let place = Place::new();
    // As the README has it, but at a port that is free.
    let port = TcpListener::bind("127.0.0.1:0").and_then(|socket| socket.local_addr());
    let port = port.expect("a port").port();
    let mut init = place.command(&kme_sim);
    init.args(["init", "certs"]).args(["--kme", &format!("kme-a=127.0.0.1:{port}=sae-a")]);
    let printed = run(init.args(["--kme", &format!("kme-b=127.0.0.2:{port}=sae-b")])).stdout;
    let env = environment(&String::from_utf8(printed).expect("text"), "sae-a");
    let mut serving = place.command(&kme_sim);
    serving.args(["run", "--strict", "certs"]).stdout(Stdio::piped());
    let mut serving = Kept(serving.spawn().expect("kme-sim"));
    let said = BufReader::new(serving.0.stdout.take().expect("a pipe"));
    assert_eq!(said.lines().take(2).count(), 2, "both KMEs listen");

    for program in programs {
        let output = run(place.command(&program).envs(env.iter().cloned()));
        let text = String::from_utf8_lossy(&output.stdout).into_owned();
        assert!(text.starts_with("tell sae-b: "), "{text}");
    }
}

/// The README's programs need nothing but what it has the reader add.
fn programs_run(name: &str) {
    assert_ne!(Readme::of(name).programs.len(), 0);
    let Some(programs) = built(name) else { return };
    for program in programs {
        run(&mut Place::new().command(&program));
    }
}

#[test]
#[ignore = "builds all that axon-envelope depends on"]
fn the_readme_of_axon_envelope_works_as_written() {
    programs_run("axon-envelope");
}

#[test]
#[ignore = "builds all that rustls-axon depends on"]
fn the_readme_of_rustls_axon_works_as_written() {
    programs_run("rustls-axon");
}

#[test]
#[ignore = "builds all that axon-tls depends on"]
fn the_readme_of_axon_tls_works_as_written() {
    programs_run("axon-tls");
}

#[test]
#[ignore = "builds all that axon-shm depends on"]
fn the_readme_of_axon_shm_works_as_written() {
    programs_run("axon-shm");
}

#[test]
#[ignore = "builds all that axon-daemon depends on"]
fn the_readme_of_axon_daemon_works_as_written() {
    let Some(programs) = built("axon-daemon") else { return };
    assert_ne!(programs.len(), 0);
    for program in programs {
        let place = Place::new();
        // No other daemon is to be found: it is its own.
        let mut own = place.with_daemon(&program);
        own.env_remove("AXON_DAEMON_PATH")
            .env("PATH", "/usr/bin:/bin")
            .env("CARGO_HOME", place.0.path());
        let printed = run(&mut own).stdout;
        let printed = String::from_utf8_lossy(&printed);
        assert!(printed.starts_with("the daemon is Some("), "{printed}");
    }
}

#[test]
#[ignore = "builds all that axon-transport and axon-cli depend on"]
fn the_readmes_of_axon_transport_and_axon_cli_work_as_written() {
    let install = format!("cargo install --locked --git {} axon-cli", env!("CARGO_PKG_REPOSITORY"));
    for readme in ["axon-transport", "axon-cli"].map(Readme::of) {
        assert!(readme.commands.contains(&install), "{install}: {:?}", readme.commands);
    }
    let Some(programs) = built("axon-transport") else { return };
    assert_ne!(programs.len(), 0);
    let install = ["--git", env!("CARGO_PKG_REPOSITORY"), "axon-cli"];
    let Some(axon) = installed(&install) else { return };
    for program in programs {
        let place = Place::new();
        // Where `cargo install` puts it, and far from what the workspace built.
        let cargo_home = place.0.path().join("cargo");
        fs::create_dir_all(cargo_home.join("bin")).expect("a directory");
        symlink(&axon, cargo_home.join("bin/axon")).expect("a link");
        let moved = place.0.path().join("program");
        fs::copy(&program, &moved).expect("a program");
        run(place.with_daemon(&moved).env("CARGO_HOME", cargo_home).env("PATH", "/usr/bin:/bin"));
        run(place.with_daemon(&moved).env("AXON_DAEMON_PATH", &axon));
    }

    let readme = Readme::of("axon-cli");
    let place = Place::new();
    let mut ran = 0;
    for line in &readme.commands {
        let mut words = line.split_whitespace();
        if words.next() == Some("axon") {
            run(place.with_daemon(&axon).args(words));
            ran += 1;
        }
    }
    assert_ne!(ran, 0, "{:?}", readme.commands);
    for command in readme.table() {
        run(place.command(&axon).args(command).arg("--help"));
    }
}
