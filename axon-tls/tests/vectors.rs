//! The checked-in vectors are what the independent script makes.

use std::io::Write;
use std::process::Command;

#[test]
fn stored_psk_vectors_match_the_script_output() {
    let directory = std::path::Path::new(env!("CARGO_TARGET_TMPDIR")).join("vectors");
    std::fs::create_dir_all(&directory).unwrap();
    let script = concat!(env!("CARGO_MANIFEST_DIR"), "/tests/vectors/make.py");
    match Command::new("python3").arg(script).current_dir(&directory).status() {
        Ok(status) => assert!(status.success(), "{status}"),
        // Past the harness, which would show it only beside a failure.
        Err(err) => {
            let _ = writeln!(std::io::stderr(), "skipped: no python3 ({err})");
            return;
        }
    }
    let made = std::fs::read_to_string(directory.join("psk.json")).unwrap();
    assert!(made == include_str!("vectors/psk.json"), "make.py makes another psk.json");
}
