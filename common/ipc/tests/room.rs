//! Too little shared memory is an error, and never a signal.

#![allow(clippy::unwrap_used, clippy::print_stderr, unreachable_pub)]

mod common;

use common::{Child, PATIENCE, Run, drain, frame, limits, never, parents_run, tell};
use rit_ipc::{CreateError, EpisodeReceiver, EpisodeSender, Limits, NoSpace, OpenError};
use std::os::unix::fs::MetadataExt as _;
use std::process::{Command, Stdio};

const MIB: u64 = 1 << 20;

#[test]
fn what_is_asked_for_is_what_is_taken() {
    for (payload_len, frames_per_sender) in [(8, 1), (common::PAYLOAD_LEN, 4), (100_000, 8), (1_000_000, 3)] {
        let limits = Limits { payload_len, max_senders: 6, frames_per_sender };
        let run = Run::new();
        let mut receiver = run.receiver(limits);
        let mut senders: Vec<_> = (0..limits.max_senders)
            .map(|_| EpisodeSender::open(&run.space, payload_len, PATIENCE).unwrap())
            .collect();
        let frame = common::frame_of(0, 0, payload_len);
        for sender in &mut senders {
            for _ in 0..frames_per_sender {
                sender.send(&frame, &never).unwrap();
            }
        }
        assert_eq!(drain(&mut receiver).len(), limits.max_senders * frames_per_sender);

        let taken: u64 = run
            .space
            .leftovers()
            .unwrap()
            .iter()
            .filter(|path| path.starts_with("/dev/shm"))
            .map(|path| 512 * path.metadata().unwrap().blocks())
            .sum();
        let asked = limits.bytes();
        assert!(taken <= asked, "{limits:?}: {taken} taken, {asked} asked for");
        assert!(asked <= taken * 11 / 10 + MIB / 2, "{limits:?}: {taken} taken, {asked} asked for");
    }
}

#[test]
fn a_machine_with_too_little_says_how_much_is_missing() {
    let run = Run::new();
    let absurd = Limits { payload_len: 1 << 40, max_senders: 1000, frames_per_sender: 1000 };
    let error = EpisodeReceiver::create(&run.space, absurd).unwrap_err();
    let CreateError::NoSpace(NoSpace { needed, free }) = error else {
        unreachable!("{error}");
    };
    assert!(nearly(needed, absurd.bytes()));
    assert!(free < needed);
}

/// What the run has taken already, a page or two, is not asked for again.
fn nearly(needed: u64, all: u64) -> bool {
    needed <= all && needed > all - 16_384
}

/// In a mount namespace of its own: a /dev/shm of 1 MiB.
#[test]
fn a_container_with_a_small_dev_shm_gives_errors_and_no_signal() {
    let namespace = |then: &str| {
        let mut command = Command::new("unshare");
        let script = format!("mount -t tmpfs -o size=1m tmpfs /dev/shm && {then}");
        command.args(["--map-root-user", "--mount", "sh", "-c", &script, "sh"]);
        command
    };
    let possible = namespace("true").stderr(Stdio::null()).status().is_ok_and(|status| status.success());
    if !possible {
        eprintln!("no user namespaces here: a small /dev/shm was only checked by comparing numbers");
        return;
    }
    let run = Run::new();
    let mut command = namespace("exec \"$@\"");
    command.arg(std::env::current_exe().unwrap());
    let mut child = Child::start_with(&run, "child_in_little_shared_memory", &mut command);
    child.expect("went through everything");
    child.finish();
}

#[test]
fn child_in_little_shared_memory() {
    let Some(space) = parents_run() else { return };

    // The learner counts for all senders.
    let large = Limits::new(200_000, 4);
    let error = EpisodeReceiver::create(&space, large).unwrap_err();
    let CreateError::NoSpace(NoSpace { needed, free }) = error else {
        unreachable!("{error}");
    };
    assert!(nearly(needed, large.bytes()));
    assert!(free > MIB / 2 && free <= MIB);

    // A sender counts for itself, when others have filled it since.
    let mut receiver = EpisodeReceiver::create(&space, limits(2, 8)).unwrap();
    let open = || EpisodeSender::open(&space, common::PAYLOAD_LEN, PATIENCE);
    fill();
    let error = open().unwrap_err();
    assert!(matches!(error, OpenError::NoSpace(_)), "{error}");
    std::fs::remove_file(FILLER).unwrap();

    // What a sender has it keeps: every frame can be written though nothing is free any more.
    let mut sender = open().unwrap();
    receiver.wait(std::time::Duration::ZERO).unwrap();
    fill();
    for episode in 0..100 {
        sender.send(&frame(0, episode), &never).unwrap();
        assert_eq!(drain(&mut receiver), [(0, episode)]);
    }
    drop((sender, receiver));
    std::fs::remove_file(FILLER).unwrap();
    space.remove().unwrap();
    tell("went through everything");
}

const FILLER: &str = "/dev/shm/filler";

/// Takes everything that is free.
fn fill() {
    let mut file = std::fs::File::create(FILLER).unwrap();
    while std::io::Write::write(&mut file, &[1; 4096]).is_ok_and(|written| written > 0) {}
}
