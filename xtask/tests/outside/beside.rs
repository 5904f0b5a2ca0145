//! The crates in one program with those that their users have, and each by itself.

use std::fs;

use crate::project::Project;
use crate::support::{reached, run, workspace};

/// What a program that uses AXON is likely to use as well, each with all its default features. They
/// bring a rustls with other providers than ours.
const NEIGHBOURS: [&str; 4] = ["quinn", "rustls", "reqwest", "zenoh"];

/// Each library of ours, all its features, and the least that it is of use with: axon-envelope needs an
/// AEAD, and says so.
const LIBRARIES: [(&str, &str, &str); 6] = [
    ("etsi-qkd014", "blocking,pool,sim", ""),
    ("axon-envelope", "aws-lc-rs,rust-crypto", "rust-crypto"),
    ("rustls-axon", "aws_lc_rs,std,logging,tls12", ""),
    ("axon-tls", "hybrid,quic,tokio", ""),
    ("axon-shm", "", ""),
    ("axon-transport", "", ""),
];

#[test]
#[ignore = "checks zenoh and all that it depends on"]
fn each_library_builds_beside_the_newest_quinn_rustls_reqwest_and_zenoh() {
    let Some(lock) = newest_neighbours() else { return };
    // Each in a project of its own: in one with the others they would switch on features for each other.
    for (library, all, _) in LIBRARIES {
        let project = Project::new(&format!("{library}-beside"));
        if project.add(&NEIGHBOURS).is_none() {
            return;
        }
        project.add(&[library, "--features", all]).expect("it is here");
        // With the same versions, what is built for one is of use to the next. Cargo takes out what
        // this one has no use for.
        project.write("Cargo.lock", &lock);
        let names = NEIGHBOURS.into_iter().chain([library]);
        let uses: String =
            names.map(|name| format!("use {} as _;\n", name.replace('-', "_"))).collect();
        project.write("src/lib.rs", &uses);
        run(&mut project.cargo(&["check"]));
    }
}

/// A lock file of all libraries with the newest neighbours. `None` without a registry.
fn newest_neighbours() -> Option<String> {
    let project = Project::new("beside");
    project.add(&NEIGHBOURS)?;
    for (library, all, _) in LIBRARIES {
        project.add(&[library, "--features", all]).expect("it is here");
    }
    // The lock file is the workspace's, and so would be their versions.
    let mut update = project.cargo(&["update"]);
    for neighbour in NEIGHBOURS {
        update.args(["--package", neighbour]);
    }
    reached(&mut update)?;
    Some(fs::read_to_string(project.dir.join("Cargo.lock")).expect("a lock file"))
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
        let manifest = fs::read_to_string(manifest).expect(library);
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
