//! Checks that the models fail when the protocol is wrong. It weakens each ordering in turn, in a separate process,
//! and expects the model that names the ordering to fail. The unmodified models run with the other tests.
//!
//! `cargo test -p axon-shm --lib mutation`

use std::{
    env,
    process::{Command, Stdio},
};

use crate::sync::Site;

/// Returns the model that fails if the site is weakened.
fn caught_by(site: Site) -> &'static str {
    use Site::*;
    match site {
        StampStore | StampLoad | ReuseFence | StandsFence => {
            "tests::model::ring::a_reader_takes_whole_samples_or_none_while_it_is_overtaken"
        }
        HeadStore | HeadLoad => "tests::model::ring::the_head_is_never_ahead_of_the_stamps",
        ArrayStore | ArrayLoad => "tests::model::growth::samples_survive_the_growth_of_their_ring",
        MappedStore | MappedLoad => "tests::model::growth::a_segment_that_is_said_to_be_mapped_is",
        TailStore | TailLoad => "tests::model::ring::a_reader_never_sees_a_tail_above_the_head",
        CursorStore | CursorLoad => {
            "tests::model::ring::\
             a_publisher_that_waits_for_the_cursor_overwrites_nothing_unread"
        }
        ReclaimFence | PinFence | UnpinStore | ScanLoad => {
            "tests::model::pins::a_sample_that_is_pinned_is_not_written_over"
        }
        PinStore => {
            "tests::model::pins::\
             a_record_that_pins_another_sample_says_that_the_last_was_read"
        }
        FreeLoad => "tests::model::pins::a_record_that_another_thread_freed_says_that_it_has_read",
        OpenStore => "tests::model::lanes::a_lane_that_is_open_shows_the_cursor_of_its_reader",
        AskStore | CloseStore | GenerationLoad => {
            "tests::model::lanes::a_reader_that_has_left_has_read_all"
        }
        LetGoSwap | TakeSwap => "tests::model::lock::a_new_holder_sees_the_last_holders_writes",
        NotedAdd | NotedLoad => {
            "tests::model::journal::a_follower_finds_each_sample_in_the_rings_that_are_named"
        }
        ArmFence | SettleFence => "wake::tests::the_last_check_or_the_doorbell_finds_every_sample",
    }
}

#[test]
fn each_ordering_is_needed_and_a_model_says_so() {
    let mut missed = Vec::new();
    for site in Site::ALL {
        let model = caught_by(site);
        let output = Command::new(env::current_exe().unwrap())
            .args(["--exact", model, "--nocapture", "--test-threads=1"])
            .env(Site::WEAKEN, format!("{site:?}"))
            .env("RUST_BACKTRACE", "0")
            .stdin(Stdio::null())
            .output()
            .unwrap();
        let said = [output.stdout, output.stderr].concat();
        let said = String::from_utf8_lossy(&said);
        assert!(said.contains("running 1 test"), "{model} did not run:\n{said}");
        if output.status.success() {
            missed.push(format!("{site:?} as {:?}: {model} passes", site.weaker()));
        }
    }
    assert!(missed.is_empty(), "no model needs these orderings:\n{}", missed.join("\n"));
}
