//! Starts a daemon from a session. The daemon's own first steps are in the daemon's `detach`.
//!
//! The command runs twice. The first process (`--spawned`) starts the second process (`--detached`) and ends, so
//! that the daemon is no child of the application, which sees neither a zombie nor a SIGCHLD. Standard output is the
//! start-up pipe. On it the daemon reports that it is ready, that another daemon was faster, or an error.

use std::{
    collections::BTreeMap,
    ffi::{OsStr, OsString},
    io::Read,
    os::{
        fd::OwnedFd,
        unix::fs::{MetadataExt, PermissionsExt},
    },
    path::{Path, PathBuf},
    process::{Command, Stdio},
    time::{Duration, Instant},
};

use axon_shm::internal::{OwnLimit, is_elevated};
use rustix::event::{PollFd, PollFlags, Timespec, poll};

use crate::{
    config::{Config, DiscoveryRange, elevated::check_owner},
    session::{error::SessionError, options::DaemonCommand},
};

/// The flag of the first process.
pub const SPAWNED: &str = "--spawned";
/// The flag of the second process.
pub const DETACHED: &str = "--detached";

/// Maximum time that a daemon may take to send its report.
const DAEMON_START_TIMEOUT: Duration = Duration::from_secs(15);
/// Maximum number of bytes read from the start-up pipe.
const MAX_REPORT: usize = 8192;

/// The report of a daemon that was started.
#[derive(Debug, PartialEq, Eq)]
pub(crate) enum SpawnOutcome {
    /// The daemon runs.
    Ready,
    /// Another daemon has the address.
    Taken,
}

/// Starts a daemon and waits for its report.
pub(crate) fn spawn(
    config: &Config,
    command: Option<&DaemonCommand>,
    cancelled: &dyn Fn() -> bool,
) -> Result<SpawnOutcome, SessionError> {
    let DaemonCommand { program, arguments } = find(config, command)?;
    let failed = |text: String| SessionError::DaemonFailed { program: program.clone(), text };
    let is_elevated = is_elevated();
    if is_elevated {
        check_owner(&program).map_err(|why| {
            failed(format!(
                "not started: this program runs with more rights than its caller, who could have put \
                 the daemon's program there: {why}"
            ))
        })?;
    }
    let (reader, writer) = std::io::pipe().map_err(|e| failed(format!("{e}{}", OwnLimit(&e))))?;
    let mut child = Command::new(&program)
        .args(arguments)
        .arg(SPAWNED)
        .env_clear()
        .envs(environment(config, std::env::vars_os(), is_elevated))
        .stdin(Stdio::null())
        .stdout(writer)
        .stderr(Stdio::null())
        .spawn()
        .map_err(|e| failed(format!("{e}{}", OwnLimit(&e))))?;
    let report = read_report(reader.into(), cancelled);
    // The first process ends as soon as it has started the second, or failed to. A program that is no daemon may stay.
    if !matches!(report.trim_end(), "ready" | "taken") {
        let _ = child.kill();
    }
    let status = child.wait();
    match report.trim_end() {
        "ready" => Ok(SpawnOutcome::Ready),
        "taken" => Ok(SpawnOutcome::Taken),
        "" => Err(failed(match status {
            Ok(status) => format!("it said nothing ({status})"),
            Err(error) => error.to_string(),
        })),
        text => Err(failed(text.strip_prefix("error: ").unwrap_or(text).to_owned())),
    }
}

/// Returns the command for a daemon: `AXON_DAEMON_PATH`, the application's own, or a program in one of the
/// [folders](folders).
fn find(config: &Config, command: Option<&DaemonCommand>) -> Result<DaemonCommand, SessionError> {
    if let Some(path) = &config.daemon_path {
        return Ok(named(path));
    }
    if let Some(command) = command {
        return Ok(command.clone());
    }
    let tried = folders(|name| std::env::var_os(name).filter(|_| !is_elevated()));
    program_in(&tried).ok_or_else(|| {
        let programs = tried.iter().flat_map(|folder| PROGRAMS.map(|name| folder.join(name)));
        let untrusted = programs.filter(|path| is_executable(path) && !is_trusted(path)).collect();
        SessionError::NoProgram { tried, untrusted }
    })
}

/// The names of the daemon's program, and of the tool, which can run as the daemon.
const PROGRAMS: [&str; 2] = ["axon_daemon", TOOL];
const TOOL: &str = "axon";

/// Returns the daemon in the first folder that has one, or else the tool in the first folder that has it.
fn program_in(folders: &[PathBuf]) -> Option<DaemonCommand> {
    PROGRAMS.into_iter().find_map(|name| {
        let program = folders.iter().map(|folder| folder.join(name)).find(|p| is_program(p))?;
        Some(named(&program))
    })
}

/// Returns the command that starts this program as a daemon: the tool has a subcommand for it.
fn named(program: &Path) -> DaemonCommand {
    let is_tool = program.file_name().is_some_and(|name| name == TOOL);
    let arguments = if is_tool { vec!["daemon".into()] } else { Vec::new() };
    DaemonCommand { program: program.to_owned(), arguments }
}

/// Returns whether this can be started as a daemon. The running program itself is skipped: an application that is
/// called `axon` would start itself without end.
fn is_program(path: &Path) -> bool {
    let itself = || match (path.canonicalize(), std::env::current_exe()) {
        (Ok(path), Ok(itself)) => path == itself,
        _ => false,
    };
    is_executable(path) && is_trusted(path) && !itself()
}

fn is_executable(path: &Path) -> bool {
    path.metadata().is_ok_and(|file| file.is_file() && file.permissions().mode() & 0o111 != 0)
}

/// Returns whether this belongs to this user or to root, and that not every user may write it. Its group may: if each
/// user has a group of its own, files are created so.
fn is_trusted(path: &Path) -> bool {
    path.metadata().is_ok_and(|file| {
        let ours = [0, rustix::process::geteuid().as_raw()].contains(&file.uid());
        ours && file.permissions().mode() & 0o002 == 0
    })
}

/// Returns the folders in which a daemon's program is looked for, in this order: beside this program, beside the
/// library that contains this code, in `PATH`, and where cargo installs programs. `variable` reads the environment.
fn folders(variable: impl Fn(&str) -> Option<OsString>) -> Vec<PathBuf> {
    let beside = [std::env::current_exe().ok(), own_file()].into_iter().flatten();
    let beside = beside.filter_map(|file| Some(file.parent()?.to_path_buf()));
    let path = variable("PATH").unwrap_or_default();
    let cargo = variable("CARGO_HOME")
        .map(PathBuf::from)
        .or_else(|| variable("HOME").map(|home| Path::new(&home).join(".cargo")));
    let mut folders = Vec::new();
    for folder in beside.chain(std::env::split_paths(&path)).chain(cargo.map(|c| c.join("bin"))) {
        // A relative path would be a different one for each process.
        if folder.is_absolute() && !folders.contains(&folder) {
            folders.push(folder);
        }
    }
    folders
}

/// Returns the file that this code was loaded from: the library, if it is in one.
fn own_file() -> Option<PathBuf> {
    let here = own_file as *const () as usize;
    let maps = std::fs::read_to_string("/proc/self/maps").ok()?;
    maps.lines().find_map(|line| {
        let (range, rest) = line.split_once(' ')?;
        let (start, end) = range.split_once('-')?;
        let start = usize::from_str_radix(start, 16).ok()?;
        let end = usize::from_str_radix(end, 16).ok()?;
        let path = rest.get(rest.find('/')?..)?;
        (start..end).contains(&here).then(|| Path::new(path).to_path_buf())
    })
}

/// Returns the environment of a daemon: the variables of this process that its system libraries need, the settings of
/// [`daemon_env`](Config), and the variables that differ between sessions.
fn environment(
    config: &Config,
    own: impl IntoIterator<Item = (OsString, OsString)>,
    is_elevated: bool,
) -> BTreeMap<OsString, OsString> {
    let daemon_env = &config.daemon_env;
    let inherited = |name: &OsString| inherited(name, is_elevated, daemon_env.inherits);
    let mut environment: BTreeMap<_, _> =
        own.into_iter().filter(|(name, _)| inherited(name)).collect();
    for (name, value) in &daemon_env.variables {
        match value {
            Some(value) => environment.insert(name.clone(), value.clone()),
            None => environment.remove(name),
        };
    }
    environment.remove(OsStr::new("ROS_LOCALHOST_ONLY"));
    environment.extend(chosen(config).map(|(name, value)| (name.into(), value.into())));
    environment
}

/// Returns whether a daemon inherits this variable: the variables that it reads, if its settings come from the
/// environment, and the variables that its system libraries need. These libraries load files that such variables name,
/// so the daemon of a process with more rights than its caller inherits only the variables that AXON reads.
fn inherited(name: &OsStr, is_elevated: bool, settings: bool) -> bool {
    const SYSTEM: &[&str] = &[
        "HOME",
        "LANG",
        "LD_LIBRARY_PATH",
        "LOGNAME",
        "PATH",
        "RUST_BACKTRACE",
        "TMPDIR",
        "TZ",
        "USER",
    ];
    const SETTINGS: &[&str] = &["AXON_", "ROS_"];
    name.to_str().is_some_and(|name| {
        (SYSTEM.contains(&name) && !is_elevated)
            || name.starts_with("LC_")
            || (settings && name == "XDG_RUNTIME_DIR" && !is_elevated)
            || (settings && SETTINGS.iter().any(|prefix| name.starts_with(prefix)))
    })
}

/// Returns the settings that a session may have been opened with instead of the environment's. A daemon that a session
/// starts has no range of its own: each session, including this one, sends its range to it.
fn chosen(config: &Config) -> [(&'static str, String); 3] {
    [
        ("ROS_DOMAIN_ID", config.domain.to_string()),
        ("ROS_AUTOMATIC_DISCOVERY_RANGE", DiscoveryRange::Off.name().to_owned()),
        ("ROS_STATIC_PEERS", String::new()),
    ]
}

fn read_report(pipe: OwnedFd, cancelled: &dyn Fn() -> bool) -> String {
    let deadline = Instant::now() + DAEMON_START_TIMEOUT;
    let mut file = std::fs::File::from(pipe);
    let mut report = Vec::new();
    let mut buffer = [0; 1024];
    while !report.contains(&b'\n') && report.len() < MAX_REPORT {
        let left = deadline.saturating_duration_since(Instant::now());
        if left.is_zero() || cancelled() {
            return format!(
                "error: it did not come up within {} s",
                DAEMON_START_TIMEOUT.as_secs()
            );
        }
        let slice = Timespec::try_from(left.min(Duration::from_millis(100))).unwrap_or_default();
        let mut fds = [PollFd::new(&file, PollFlags::IN)];
        if !matches!(poll(&mut fds, Some(&slice)), Ok(1..)) {
            continue;
        }
        match file.read(&mut buffer) {
            Ok(0) | Err(_) => break,
            Ok(n) => report.extend_from_slice(&buffer[..n]),
        }
    }
    String::from_utf8_lossy(&report).into_owned()
}

#[cfg(test)]
mod tests {
    use std::fs;

    use super::*;

    #[test]
    fn folders_of_path_and_cargo_come_after_those_beside_the_program() {
        let variable = |name: &str| match name {
            "PATH" => Some("/usr/bin:relative::/opt/axon:/usr/bin".into()),
            "HOME" => Some("/home/user".into()),
            _ => None,
        };
        let beside = std::env::current_exe().unwrap().parent().unwrap().to_path_buf();
        let rest = ["/usr/bin", "/opt/axon", "/home/user/.cargo/bin"].map(PathBuf::from);
        let found = folders(variable);
        assert_eq!(found[0], beside);
        assert!(found.ends_with(&rest), "{found:?}");
        let cargo = |name: &str| (name == "CARGO_HOME").then(|| "/opt/cargo".into());
        assert_eq!(folders(cargo).last(), Some(&"/opt/cargo/bin".into()));
        assert_eq!(folders(|_| None), [beside]);
    }

    #[test]
    fn a_spawned_daemon_gets_only_the_settings_of_its_session() {
        let own = || {
            [
                ("PATH", "/bin"),
                ("LC_ALL", "C"),
                ("AXON_LOG", "trace"),
                ("AXON_STRICT_ENV", "1"),
                ("ROS_LOCALHOST_ONLY", "1"),
                ("XDG_RUNTIME_DIR", "/run/user/1"),
                ("EDITOR", "vi"),
            ]
            .map(|(name, value)| (name.into(), value.into()))
        };
        let names = |config: &Config, is_elevated| {
            let names = environment(config, own(), is_elevated).into_keys();
            names.map(|name| name.into_string().unwrap()).collect::<Vec<_>>()
        };
        let ros = ["ROS_AUTOMATIC_DISCOVERY_RANGE", "ROS_DOMAIN_ID", "ROS_STATIC_PEERS"];
        let built = Config::default();
        assert_eq!(names(&built, false), [&["AXON_CONFIG", "LC_ALL", "PATH"], &ros[..]].concat());
        assert_eq!(names(&built, true), [&["AXON_CONFIG", "LC_ALL"], &ros[..]].concat());
        let mut read = Config::default();
        read.daemon_env.inherits = true;
        read.daemon_env.variables.clear();
        let of_axon = ["AXON_LOG", "AXON_STRICT_ENV", "LC_ALL"];
        assert_eq!(
            names(&read, false),
            [&of_axon[..], &["PATH"], &ros, &["XDG_RUNTIME_DIR"]].concat()
        );
        assert_eq!(names(&read, true), [&of_axon[..], &ros].concat());
    }

    #[test]
    fn a_setting_may_name_the_tool_or_a_daemon_of_any_other_name() {
        for (path, arguments) in
            [("/opt/axon", &["daemon"][..]), ("/opt/axon_daemon", &[]), ("/opt/axon/mine", &[])]
        {
            let command = named(Path::new(path));
            assert_eq!((command.program, command.arguments.len()), (path.into(), arguments.len()));
            assert!(command.arguments.iter().eq(arguments), "{path}: {:?}", command.arguments);
        }
    }

    #[test]
    fn the_daemon_is_preferred_to_the_tool_and_unusable_files_are_skipped() {
        let dir = tempfile::tempdir().unwrap();
        let file = |name: &str, mode| {
            let path = dir.path().join(name);
            fs::write(&path, "").unwrap();
            fs::set_permissions(&path, fs::Permissions::from_mode(mode)).unwrap();
            path
        };
        let other = tempfile::tempdir().unwrap();
        let folders = [other.path().to_path_buf(), dir.path().to_path_buf()];
        assert!(program_in(&folders).is_none());
        let tool = file("axon", 0o755);
        let daemon = file("axon_daemon", 0o644);
        let found = program_in(&folders).unwrap();
        assert_eq!((found.program, found.arguments), (tool, vec![OsString::from("daemon")]));
        // Another user's tool in an earlier folder.
        fs::write(other.path().join("axon"), "").unwrap();
        fs::set_permissions(other.path().join("axon"), fs::Permissions::from_mode(0o755)).unwrap();
        fs::set_permissions(&daemon, fs::Permissions::from_mode(0o757)).unwrap();
        assert_ne!(program_in(&folders).unwrap().program, daemon, "everybody may replace it");
        assert!(is_executable(&daemon) && !is_trusted(&daemon));
        fs::set_permissions(&daemon, fs::Permissions::from_mode(0o755)).unwrap();
        let found = program_in(&folders).unwrap();
        assert_eq!((found.program, found.arguments), (daemon, vec![]));
    }
}
