//! Every check, on its seeds and on what is one step away from them. No fuzzer needed.

use axon_fuzz::TARGETS;

#[test]
fn seeds_are_accepted_and_their_neighbours_keep_the_properties() {
    for target in TARGETS {
        for (number, seed) in (target.seeds)().into_iter().enumerate() {
            assert!((target.check)(&seed), "{}: seed {number} is refused", target.name);
            for at in 0..seed.len().min(512) {
                (target.check)(&seed[..at]);
                (target.check)(&[&seed[..at], &seed[at + 1..]].concat());
                for change in [0x01, 0x20, 0x80, 0xff] {
                    let mut changed = seed.clone();
                    changed[at] ^= change;
                    (target.check)(&changed);
                }
            }
        }
    }
}

#[test]
fn every_target_has_a_binary_and_every_binary_is_a_target() {
    let directory = concat!(env!("CARGO_MANIFEST_DIR"), "/fuzz_targets");
    let mut binaries: Vec<String> = std::fs::read_dir(directory)
        .unwrap()
        .map(|entry| entry.unwrap().path().file_stem().unwrap().to_string_lossy().into_owned())
        .collect();
    let mut targets: Vec<&str> = TARGETS.iter().map(|target| target.name).collect();
    binaries.sort_unstable();
    targets.sort_unstable();
    assert_eq!(targets, binaries);
}
