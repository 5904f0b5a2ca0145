//! A child that publishes until it is killed, and writes its progress to a file.

use std::{
    fs::{self, File},
    os::unix::fs::FileExt as _,
    path::PathBuf,
};

use super::*;

fn len_of(sequence: u64) -> usize {
    sequence as usize % 10_000
}

fn file(runtime_dir: &str) -> PathBuf {
    PathBuf::from(runtime_dir).with_file_name("talker")
}

/// In a child: publishes without end.
pub(super) fn talk(session: &Session) {
    let told = File::create(file(&std::env::var("AXON_RUNTIME_DIR").unwrap())).unwrap();
    let publisher = session.create_publisher(spec("/t", Qos::keep_all())).unwrap();
    assert!(publisher.wait_matched(1, PATIENCE));
    for sequence in 1.. {
        publish(&publisher, &pattern(sequence, len_of(sequence)));
        // A kill leaves each of the two numbers either old or new.
        let acknowledged = sequence - publisher.unacknowledged();
        for (number, at) in [(acknowledged, 8), (sequence, 0)] {
            told.write_all_at(&number.to_ne_bytes(), at).unwrap();
        }
    }
}

/// Takes the remaining samples of the killed talker, of which the first hundred were taken before. Checks that all are
/// whole and none is missing in between, and that the acknowledged samples are among them. Samples that were not
/// acknowledged, and that the daemon does not count, were still in the memory of the killed process.
pub(super) fn take_rest_of_talker(host: &Host, subscription: &Subscription) {
    let mut bytes = Vec::new();
    let mut taken = 100;
    while let Some(info) = subscription.take(&mut bytes) {
        assert_eq!((info.sequence, bytes.len()), (taken + 1, len_of(taken + 1)));
        taken += 1;
    }
    let (_, runtime_dir) = host.env.iter().find(|(name, _)| name == "AXON_RUNTIME_DIR").unwrap();
    let told = fs::read(file(runtime_dir)).unwrap();
    let [published, acknowledged] =
        [0, 8].map(|at| u64::from_ne_bytes(told[at..at + 8].try_into().unwrap()));
    let counted = left::dropped(host, "publisher_ended");
    let known = taken + subscription.lost() + counted;
    eprintln!(
        "{published} published, {acknowledged} acknowledged, {taken} taken, {counted} counted"
    );
    assert!(acknowledged <= taken, "{taken} came of {acknowledged} that were acknowledged");
    // It may have been killed before it recorded its last sample.
    assert!(known <= published + 1, "{known} of {published}");
}
