//! `tests/ros/flaky`, by which a run of the tests with ROS 2 shows which tests failed and then passed.

mod support;

use std::{
    fs,
    path::Path,
    process::{Command, Output},
};

use support::workspace;

fn flaky(args: [&Path; 3]) -> Output {
    let [what, first, second] = args;
    let mut command = Command::new(workspace().join("tests/ros/flaky"));
    command.arg(what).arg(first);
    if second != Path::new("") {
        command.arg(second);
    }
    command.output().expect("bash")
}

fn text(bytes: &[u8]) -> String {
    String::from_utf8(bytes.to_vec()).expect("text")
}

#[test]
fn a_test_that_failed_and_then_passed_is_flaky() {
    let dir = tempfile::tempdir().expect("a directory");
    let (first, second) = (dir.path().join("first"), dir.path().join("second"));
    // The text is in the form in which pytest writes its cache.
    let failed = "{\n  \"tests/ros/test_a.py::test_x[1-a b]\": true,\n  \
                  \"tests/ros/test_a.py::test_y\": true,\n  \"tests/ros/test_b.py::test_z\": true\n}";
    fs::write(&first, failed).expect("written");
    for (again, wanted) in [
        (failed, ""),
        (
            "{\n  \"tests/ros/test_a.py::test_y\": true\n}",
            "tests/ros/test_a.py::test_x[1-a b]\ntests/ros/test_b.py::test_z\n",
        ),
        (
            "{}",
            "tests/ros/test_a.py::test_x[1-a b]\ntests/ros/test_a.py::test_y\n\
             tests/ros/test_b.py::test_z\n",
        ),
    ] {
        fs::write(&second, again).expect("written");
        let output = flaky([Path::new("compare"), &first, &second]);
        assert!(output.status.success(), "{}", text(&output.stderr));
        assert_eq!(text(&output.stdout), wanted);
    }
    let output = flaky([Path::new("compare"), &first, Path::new("/nowhere")]);
    assert!(!output.status.success(), "a file that is not there is no empty one");
}

#[test]
fn one_flaky_test_is_shown_and_two_fail_the_run() {
    let dir = tempfile::tempdir().expect("a directory");
    let file = dir.path().join("flaky");
    let report = |names: &str| {
        fs::write(&file, names).expect("written");
        let output = flaky([Path::new("report"), &file, Path::new("")]);
        let shown = text(&output.stdout);
        let named = shown.lines().filter_map(|line| line.strip_prefix("FLAKY:   "));
        (output.status.code(), named.map(str::to_owned).collect::<Vec<_>>(), shown.lines().count())
    };
    assert_eq!(report(""), (Some(0), vec![], 0));
    assert_eq!(report("a::b\n"), (Some(0), vec!["a::b".to_owned()], 4));
    // A test that is listed twice counts once.
    assert_eq!(report("a::b\na::b\n"), (Some(0), vec!["a::b".to_owned()], 4));
    let two = vec!["a::b".to_owned(), "c::d e".to_owned()];
    assert_eq!(report("c::d e\na::b\n"), (Some(1), two, 5));
}
