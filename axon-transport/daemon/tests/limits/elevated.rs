//! Programs that run with more rights than their callers: files that the caller's environment names are neither
//! executed nor read.

use std::{
    fs,
    os::unix::{fs::PermissionsExt as _, process::CommandExt as _},
    path::{Path, PathBuf},
    process::{Command, Stdio},
};

use axon_transport::{Session, SessionOptions, config::Config};

use crate::{skip::skip, support::say};

const NOBODY: u32 = 65534;

/// The child: reports AT_SECURE, and the effects of its environment.
pub(crate) fn play() {
    // SAFETY: the call only looks up a number.
    say(format!("AT_SECURE {}", unsafe { libc::getauxval(libc::AT_SECURE) }));
    match Config::from_env() {
        Err(error) => say(format!("refused {error}")),
        Ok(config) => match Session::open(&config, SessionOptions::new("elevated")) {
            Ok(_) => say("opened"),
            Err(error) => say(format!("not opened {error}")),
        },
    }
}

/// A copy of this program, and the files that its caller has prepared for it.
struct Trap {
    dir: PathBuf,
}

impl Trap {
    /// Creates the trap; `None` if this process cannot act as two users.
    fn new(name: &str) -> Option<Self> {
        if !rustix::process::geteuid().is_root() {
            skip("only root can be two users");
            return None;
        }
        let dir = Path::new("/tmp").join(format!("axon-elevated-{name}-{}", std::process::id()));
        let trap = Self { dir };
        fs::create_dir(&trap.dir).unwrap();
        mode(&trap.dir, 0o755);
        copy(&std::env::current_exe().unwrap(), &trap.program());
        mode(&trap.program(), 0o755);
        fs::create_dir(trap.path("open")).unwrap();
        mode(&trap.path("open"), 0o777);
        let script = format!("#!/bin/sh\n: > {}\n", trap.path("open/executed").display());
        fs::write(trap.path("script"), script).unwrap();
        copy(&trap.path("script"), &trap.path("daemon"));
        mode(&trap.path("daemon"), 0o755);
        fs::create_dir(trap.path("bin")).unwrap();
        copy(&trap.path("daemon"), &trap.path("bin/axon_daemon"));
        fs::write(trap.path("axon.toml.of_caller"), "daemon_path = \"daemon\"\n").unwrap();
        mode(&trap.path("axon.toml.of_caller"), 0o644);
        Some(trap)
    }

    fn path(&self, name: &str) -> PathBuf {
        self.dir.join(name)
    }

    fn program(&self) -> PathBuf {
        self.path("program")
    }

    /// Returns the output of the program when the user nobody runs it with this variable.
    fn run(&self, program: &Path, name: &str, value: &Path) -> String {
        let output = Command::new(program)
            .args(["child", "--exact", "--nocapture", "--test-threads=1"])
            .env_clear()
            .env("PLAY", "elevated")
            .env("ROS_DOMAIN_ID", "172")
            .env(name, value)
            .current_dir("/")
            .uid(NOBODY)
            .gid(NOBODY)
            .stdin(Stdio::null())
            .output()
            .unwrap();
        String::from_utf8(output.stdout).unwrap() + &String::from_utf8_lossy(&output.stderr)
    }

    fn was_executed(&self) -> bool {
        fs::remove_file(self.path("open/executed")).is_ok()
    }

    /// Checks that the variables work with the caller's own rights, so that the trap is a real one.
    fn works(&self) {
        let said = self.run(&self.program(), "AXON_DAEMON_PATH", &self.path("daemon"));
        assert!(said.contains("AT_SECURE 0"), "{said}");
        assert!(self.was_executed(), "{said}");
        let said = self.run(&self.program(), "AXON_CONFIG", &self.path("axon.toml.of_caller"));
        assert!(self.was_executed(), "{said}");
        for (name, value) in self.folders() {
            let said = self.run(&self.program(), name, &value);
            assert!(self.was_executed(), "{name}: {said}");
        }
    }

    /// Variables that name folders of programs, in any program.
    fn folders(&self) -> [(&'static str, PathBuf); 2] {
        [("PATH", self.path("bin")), ("CARGO_HOME", self.dir.clone())]
    }

    /// Checks that they do not work with the rights of others. Returns whether the kernel gives such rights here.
    fn holds(&self) -> bool {
        let file = self.path("axon.toml.of_caller");
        let said = self.run(&self.program(), "AXON_DAEMON_PATH", &self.path("daemon"));
        if said.contains("AT_SECURE 0") {
            return false;
        }
        for (name, value) in [
            ("AXON_DAEMON_PATH", &self.path("daemon")),
            ("AXON_CONFIG", &file),
            ("AXON_CLASSIC_KEY", &file),
            ("AXON_CLASSIC_TRUST", &file),
            ("AXON_CLASSIC_CA", &file),
            ("AXON_CLASSIC_CERT", &file),
            ("AXON_CLASSIC_CRL", &file),
            ("AXON_KME_CA", &file),
            ("AXON_SAE_CERT", &file),
            ("AXON_SAE_KEY", &file),
            ("AXON_ACCESS_FILE", &file),
            ("AXON_LINK_QLOG", &self.path("open")),
            ("AXON_RUNTIME_DIR", &self.path("open")),
            ("AXON_TRUSTED_UIDS", &PathBuf::from("65534")),
        ] {
            let said = self.run(&self.program(), name, value);
            assert!(said.contains(&format!("refused {name}")), "{said}");
            assert!(said.contains("set-uid, set-gid or file capabilities"), "{said}");
        }
        for (name, value) in self.folders() {
            let said = self.run(&self.program(), name, &value);
            assert!(said.contains("not opened"), "{name}: {said}");
        }
        assert!(!self.was_executed());
        // The variable is not an error but ignored: there is no daemon beside the program.
        let said = self.run(&self.program(), "XDG_RUNTIME_DIR", &self.path("open"));
        assert!(said.contains("not opened"), "{said}");
        assert_eq!(fs::read_dir(self.path("open")).unwrap().count(), 0, "{said}");
        true
    }
}

impl Drop for Trap {
    fn drop(&mut self) {
        let _ = fs::remove_dir_all(&self.dir);
    }
}

/// Copies a program through another process. If this process wrote it, a child that another test forks meanwhile would
/// have it open for writing, and executing it would fail (ETXTBSY).
fn copy(from: &Path, to: &Path) {
    assert!(Command::new("cp").args([from, to]).status().unwrap().success());
}

fn mode(path: &Path, mode: u32) {
    fs::set_permissions(path, fs::Permissions::from_mode(mode)).unwrap();
}

#[test]
fn a_set_uid_program_takes_no_paths_from_its_callers_environment() {
    let Some(trap) = Trap::new("uid") else { return };
    trap.works();
    mode(&trap.program(), 0o4755);
    if !trap.holds() {
        return skip("set-uid programs get no rights on /tmp (nosuid)");
    }
    // The caller places the program beside its own files by a hard link.
    let linked = trap.path("open/program");
    fs::hard_link(trap.program(), &linked).unwrap();
    for name in ["axon_daemon", "axon.toml"] {
        let from = if name == "axon.toml" { "axon.toml.of_caller" } else { "daemon" };
        copy(&trap.path(from), &trap.path("open").join(name));
        let said = trap.run(&linked, "HOME", Path::new("/"));
        assert!(!trap.was_executed(), "{said}");
        assert!(said.contains("its caller") || said.contains("caller of this program"), "{said}");
    }
}

#[test]
fn a_set_gid_program_takes_no_paths_from_its_callers_environment() {
    let Some(trap) = Trap::new("gid") else { return };
    mode(&trap.program(), 0o2755);
    if !trap.holds() {
        skip("set-gid programs get no rights on /tmp (nosuid)");
    }
}

#[test]
fn a_program_with_file_capabilities_takes_no_paths_from_its_callers_environment() {
    let Some(trap) = Trap::new("caps") else { return };
    let set = Command::new("setcap").arg("cap_net_raw+ep").arg(trap.program()).status();
    if !set.is_ok_and(|status| status.success()) {
        return skip("no file can be given capabilities here: setcap is missing or failed");
    }
    if !trap.holds() {
        skip("file capabilities give no rights on /tmp (nosuid)");
    }
}
