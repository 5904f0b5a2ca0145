//! `axon trust keygen` and `axon trust list` as a user runs them.

#![forbid(unsafe_code)]

mod common;

use std::{
    fs,
    os::unix::fs::{PermissionsExt, symlink},
    path::Path,
    process::Output,
};

use axon_tls::identity::{SigningKey, SpkiDigest, TrustFile};
use common::axon;

const DIGEST: &str = "spki-sha256:47DEQpj8HBSa+/TImW+5JCeuQeRkm5NMpJWZG3hSuFU=";

fn trust(args: &[&str], settings: &[(&str, &str)]) -> Output {
    axon(settings.iter().copied()).arg("trust").args(args).output().expect("runs")
}

fn text(bytes: &[u8]) -> String {
    String::from_utf8(bytes.to_vec()).expect("text")
}

fn utf8(path: &Path) -> &str {
    path.to_str().expect("UTF-8")
}

/// Checks that the command fails with `status` and prints only one line, which contains `said`.
#[track_caller]
fn refused(args: &[&str], settings: &[(&str, &str)], status: i32, said: &str) {
    let output = trust(args, settings);
    let stderr = text(&output.stderr);
    assert_eq!(output.status.code(), Some(status), "{args:?}: {stderr}");
    assert!(stderr.contains(said), "{args:?}: {said:?} is missing in {stderr}");
    assert_eq!(stderr.lines().count(), 1, "{args:?}: {stderr}");
    assert_eq!(output.stdout, b"", "{args:?}");
}

/// Runs and succeeds; standard output.
#[track_caller]
fn done(args: &[&str], settings: &[(&str, &str)]) -> String {
    let output = trust(args, settings);
    assert!(output.status.success(), "{args:?}: {}", text(&output.stderr));
    assert_eq!(text(&output.stderr), "", "{args:?}");
    text(&output.stdout)
}

#[test]
fn a_file_that_exists_is_never_overwritten() {
    let dir = tempfile::tempdir().expect("directory");
    let key = dir.path().join("host.key");
    fs::write(&key, "something dear").expect("writable");
    refused(&["keygen", utf8(&key)], &[], 1, utf8(&key));
    refused(&["keygen", utf8(&key)], &[], 1, "exists, and is not overwritten; delete it");
    assert_eq!(fs::read_to_string(&key).expect("still there"), "something dear");

    // The target of a link is not created either: another user may have made the link.
    let (link, target) = (dir.path().join("link"), dir.path().join("target"));
    symlink(&target, &link).expect("a link");
    refused(&["keygen", utf8(&link)], &[], 1, utf8(&link));
    assert!(!target.exists());
    refused(&["keygen", utf8(dir.path())], &[], 1, utf8(dir.path()));
}

#[test]
fn a_directory_that_cannot_be_written_is_named() {
    // These paths fail without permissions, which do not stop root.
    for (path, said) in [
        ("/proc/axon-host.key", ""),
        ("/nowhere/host.key", "its directory does not exist; make that first"),
        ("/dev/null/host.key", ""),
    ] {
        refused(&["keygen", path], &[], 1, path);
        refused(&["keygen", path], &[], 1, said);
    }
}

#[test]
fn a_name_that_no_trust_file_can_hold_leaves_no_key_behind() {
    let dir = tempfile::tempdir().expect("directory");
    let key = dir.path().join("host.key");
    for name in ["", "two words", "a#b", "a\nb", "\u{e4}", "\u{1b}[2J"] {
        refused(&["keygen", utf8(&key), "--name", name], &[], 2, "--name");
        assert!(!key.exists(), "{name:?}");
    }
    let args = ["keygen", utf8(&key), "--algorithm", "rsa"];
    assert_eq!(trust(&args, &[]).status.code(), Some(2));
    assert!(!key.exists());
}

#[test]
fn key_file_is_private_and_the_printed_line_fits_a_trust_file() {
    let dir = tempfile::tempdir().expect("directory");
    for (algorithm, args) in
        [("default", &[][..]), ("ed25519", &["--algorithm", "ed25519", "--name", "arm-2"])]
    {
        let key = dir.path().join(algorithm);
        let printed = done(&[&["keygen", utf8(&key)], args].concat(), &[]);
        let mode = fs::metadata(&key).expect("made").permissions().mode();
        assert_eq!(mode & 0o7777, 0o600, "{algorithm}");

        let pem = fs::read_to_string(&key).expect("PEM");
        let own = SigningKey::from_pem(&pem).expect("a key").spki_digest();
        let file = TrustFile::parse(&printed).expect("a trust file");
        let pins: Vec<_> = file.pins().map(|pin| pin.key()).collect();
        assert_eq!((pins, printed.lines().count()), (vec![own], 1), "{printed}");
        assert!(!args.contains(&"arm-2") || printed.starts_with("arm-2 "), "{printed}");
    }
    // An ML-DSA-65 key is the seed of more than an Ed25519 key is.
    let len = |name: &str| fs::metadata(dir.path().join(name)).expect("made").len();
    assert!(len("ed25519") < 200, "{}", len("ed25519"));
    assert!(len("default") > len("ed25519"));
}

#[test]
fn no_mask_opens_the_key_and_half_a_key_is_not_left_behind() {
    let dir = tempfile::tempdir().expect("directory");
    let shell = |before: &str, name: &str| {
        let key = dir.path().join(name);
        let script = format!("{before}; exec \"$0\" trust keygen \"$1\" --name a");
        let arguments = ["-c", &script, env!("CARGO_BIN_EXE_axon"), utf8(&key)];
        let output = std::process::Command::new("sh").args(arguments).output().expect("a shell");
        (output, key)
    };
    let (output, key) = shell("umask 0", "open");
    assert!(output.status.success(), "{}", text(&output.stderr));
    let mode = fs::metadata(&key).expect("made").permissions().mode();
    assert_eq!(mode & 0o7777, 0o600);

    // No byte of it can be written.
    let (output, key) = shell("trap '' XFSZ; ulimit -f 0", "full");
    let stderr = text(&output.stderr);
    assert_eq!((output.status.code(), &output.stdout[..]), (Some(1), &b""[..]), "{stderr}");
    assert!(stderr.contains(utf8(&key)) && !key.exists(), "{stderr}");
}

#[test]
fn the_key_is_the_one_that_openssl_reads() {
    let dir = tempfile::tempdir().expect("directory");
    let key = dir.path().join("host.key");
    let printed = done(&["keygen", utf8(&key), "--algorithm", "ed25519", "--name", "a"], &[]);
    let spki = std::process::Command::new("openssl")
        .args(["pkey", "-in", utf8(&key), "-pubout", "-outform", "DER"])
        .output();
    // Only where there is one.
    let Ok(spki) = spki else { return };
    assert!(spki.status.success(), "{}", text(&spki.stderr));
    assert_eq!(printed, format!("a {}\n", SpkiDigest::of(&spki.stdout)));
}

#[test]
fn a_line_that_cannot_be_used_is_named_with_its_file() {
    let dir = tempfile::tempdir().expect("directory");
    let file = dir.path().join("trust");
    let good = format!("# peers\narm {DIGEST}\n");
    for garbage in [
        b"robot".to_vec(),
        b"robot spki-sha256:AAAA".to_vec(),
        b"\x7fELF\x02\x01\x01\0\0".to_vec(),
        b"robot \xff\xfe".to_vec(),
        format!("again {DIGEST}").into_bytes(),
        format!("arm {} tomorrow", SpkiDigest([1; 32])).into_bytes(),
        b"-----BEGIN PRIVATE KEY-----".to_vec(),
        b"\x1b[2J".to_vec(),
    ] {
        let content = [good.as_bytes(), &garbage].concat();
        fs::write(&file, content).expect("writable");
        let said = format!("{}, line 3: ", utf8(&file));
        refused(&["list", utf8(&file)], &[], 1, &said);
        let stderr = text(&trust(&["list", utf8(&file)], &[]).stderr);
        assert!(!stderr.contains('\x1b'), "{stderr:?}");
    }
    fs::write(&file, vec![b'#'; TrustFile::MAX_LEN + 1]).expect("writable");
    refused(&["list", utf8(&file)], &[], 1, "larger than 1 MiB");
    refused(&["list", utf8(dir.path())], &[], 1, utf8(dir.path()));
    refused(&["list", utf8(dir.path())], &[], 1, "is a directory, not a file");
    refused(&["list", "/nowhere/trust"], &[], 1, "/nowhere/trust: there is no such file");
    // Endless, and no text.
    refused(&["list", "/dev/zero"], &[], 1, "/dev/zero");
}

#[test]
fn trust_list_names_a_bad_key_file_without_its_content() {
    let dir = tempfile::tempdir().expect("directory");
    let (file, key) = (dir.path().join("trust"), dir.path().join("host.key"));
    fs::write(&file, format!("arm {DIGEST}\n")).expect("writable");
    for content in [
        &b"hunter2"[..],
        b"\xff\xfe hunter2",
        b"-----BEGIN PRIVATE KEY-----\nhunter2\n-----END PRIVATE KEY-----\n",
    ] {
        fs::write(&key, content).expect("writable");
        let args = ["list", utf8(&file), "--key", utf8(&key)];
        refused(&args, &[], 1, utf8(&key));
        let made_by = if content.starts_with(b"\xff") { "utf-8" } else { "axon trust keygen" };
        refused(&args, &[], 1, made_by);
        assert!(!text(&trust(&args, &[]).stderr).contains("hunter2"));
    }
    refused(&["list", utf8(&file), "--key", "/dev/zero"], &[], 1, "too large");
}

#[test]
fn without_a_file_the_settings_say_which() {
    let dir = tempfile::tempdir().expect("directory");
    let (file, key) = (dir.path().join("trust"), dir.path().join("host.key"));
    let own = done(&["keygen", utf8(&key), "--name", "base"], &[]);
    let content = format!("{own}arm {DIGEST} 2001-02-03\n");
    fs::write(&file, content).expect("writable");
    let settings = [("AXON_CLASSIC_KEY", utf8(&key)), ("AXON_CLASSIC_TRUST", utf8(&file))];

    let listed = done(&["list"], &settings);
    let lines: Vec<_> = listed.lines().collect();
    let row = |name: &str| *lines.iter().find(|line| line.starts_with(name)).expect("a row");
    assert!(row("arm ").contains(DIGEST), "{listed}");
    assert!(row("arm ").contains("2001-02-03") && row("arm ").ends_with("expired"), "{listed}");
    assert!(row("base ").ends_with("valid, this host"), "{listed}");
    let digest = own.trim_end().strip_prefix("base ").expect("the line");
    assert_eq!(lines.last(), Some(&format!("this host: {digest}").as_str()), "{listed}");
    assert_eq!(done(&["list", utf8(&file)], &settings), listed);
    assert_eq!(done(&["list", utf8(&file), "--key", utf8(&key)], &[]), listed);
    assert!(!done(&["list", utf8(&file)], &[]).contains("this host"));

    refused(&["list"], &[], 2, "AXON_CLASSIC_TRUST");
    refused(&["list"], &settings[..1], 2, "AXON_CLASSIC_TRUST");
    refused(&["list"], &[("AXON_QKD_TYPO", "x")], 2, "AXON_QKD_TYPO");
    // A file can be looked at before the settings are complete; why nothing is marked is said.
    let output = trust(&["list", utf8(&file)], &settings[..1]);
    assert!(output.status.success());
    assert!(text(&output.stderr).contains("AXON_CLASSIC_TRUST"), "{}", text(&output.stderr));
    assert!(!text(&output.stdout).contains("this host"));
}

#[test]
fn the_help_of_each_command_fits_a_page_and_shows_an_example() {
    for command in ["keygen", "scan", "list"] {
        let help = done(&[command, "--help"], &[]);
        assert!(help.contains(&format!("axon trust {command}")), "{help}");
        assert!(help.lines().all(|line| line.chars().count() <= 100), "{help}");
    }
}
