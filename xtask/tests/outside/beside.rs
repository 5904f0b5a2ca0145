//! The crates in one program with those that their users have, and each by itself.

use crate::project::Project;
use crate::support::{reached, run, workspace};

/// What a program that uses AXON is likely to use as well, each with all its default features. They
/// bring a rustls with other providers than ours.
const NEIGHBOURS: [&str; 4] = ["quinn", "rustls", "reqwest", "zenoh"];

/// Each library of ours, all its features, and the least that it is of use with: axon-envelope needs an
/// AEAD, and says so.
const LIBRARIES: [(&str, &str, &str); 7] = [
    ("etsi-qkd014", "blocking,pool,sim", ""),
    ("axon-envelope", "aws-lc-rs,rust-crypto", "rust-crypto"),
    ("rustls-axon", "aws_lc_rs,std,logging,tls12", ""),
    ("axon-tls", "hybrid,quic,tokio", ""),
    ("axon-shm", "", ""),
    ("axon-transport", "sros2", ""),
    ("axon-daemon", "", ""),
];

/// Checks a program with these of ours, all their features, and the newest of each neighbour. `None` without
/// a registry.
fn check_beside(name: &str, libraries: &[(&str, &str, &str)]) -> Option<()> {
    let project = Project::new(name);
    for neighbour in NEIGHBOURS {
        project.add(&[neighbour])?;
    }
    for (library, all, _) in libraries {
        project.add(&[library, "--features", all]).expect("it is here");
    }
    // The lock file is the workspace's, and so would be their versions.
    for neighbour in NEIGHBOURS {
        reached(&mut project.cargo(&["update", "--package", neighbour]))?;
    }
    let names = NEIGHBOURS.iter().chain(libraries.iter().map(|(name, ..)| name));
    let uses: String =
        names.map(|name| format!("use {} as _;\n", name.replace('-', "_"))).collect();
    project.write("src/lib.rs", &uses);
    run(&mut project.cargo(&["check", "--locked"]));
    Some(())
}

// One program with all of ours: with a program for each, cargo builds zenoh anew for each, since the features that
// each lends to what they share differ. What one of ours lends another here, the next test does not.
#[test]
#[ignore = "checks zenoh and all that it depends on"]
fn all_crates_build_beside_the_newest_quinn_rustls_reqwest_and_zenoh() {
    check_beside("beside", &LIBRARIES);
}

// `.ci/run` leaves it out: CONTRIBUTING.md has its command.
#[test]
#[ignore = "checks zenoh and all that it depends on once for each library"]
fn each_library_alone_builds_beside_the_neighbours() {
    for library in LIBRARIES {
        if check_beside(&format!("{}-beside", library.0), &[library]).is_none() {
            return;
        }
    }
}

#[test]
#[ignore = "checks all that the crates depend on, without features and with all"]
fn each_library_builds_alone_without_features_and_with_all() {
    for (library, all, least) in LIBRARIES {
        for (which, features) in [("least", least), ("all", all)] {
            let project = Project::new(&format!("{library}-{which}"));
            let add = [library, "--no-default-features", "--features", features];
            if project.add(&add).is_none() {
                return;
            }
            project.write("src/lib.rs", &format!("use {} as _;\n", library.replace('-', "_")));
            run(&mut project.cargo(&["check"]));
        }
    }
}

/// [`LIBRARIES`] would not know of a new feature.
#[test]
fn all_features_are_listed() {
    for (library, all, least) in LIBRARIES {
        let (_, dir) = crate::PUBLISHED.iter().find(|(name, _)| *name == library).expect(library);
        let manifest = workspace().join(dir).join("Cargo.toml");
        let manifest = std::fs::read_to_string(manifest).expect(library);
        let features = manifest.split_once("\n[features]\n").map_or("", |(_, rest)| rest);
        let features = features.split("\n[").next().unwrap_or_default();
        let names =
            features.lines().filter_map(|line| line.split_once(" = ")).map(|(name, _)| name);
        let mut names: Vec<&str> = names.filter(|name| *name != "default").collect();
        let mut listed: Vec<&str> = all.split(',').filter(|name| !name.is_empty()).collect();
        names.sort_unstable();
        listed.sort_unstable();
        assert_eq!(names, listed, "{library}");
        assert!(least.is_empty() || listed.contains(&least), "{library}");
    }
}
