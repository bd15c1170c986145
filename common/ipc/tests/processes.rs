//! Real processes, killed at bad moments. Tests named `child_…` are the other processes of these tests; by
//! themselves they do nothing.

#![allow(clippy::unwrap_used, unreachable_pub)]

mod common;

use common::{
    Child, PATIENCE, PATTERNS, PAYLOAD_LEN, Run, drain, frame, frame_of, hear, identify, limits, never, next,
    parents_run, tell,
};
use rit_ipc::{CreateError, EpisodeReceiver, EpisodeSender, Limits, OpenError, Reaped, SendError};
use std::path::{Path, PathBuf};

const REAPED_ONE: Reaped = Reaped { removed: 1, left: 0 };

#[test]
fn child_sends_three_and_stays() {
    let Some(space) = parents_run() else { return };
    let mut sender = EpisodeSender::open(&space, PAYLOAD_LEN, PATIENCE).unwrap();
    for episode in 0..3 {
        sender.send(&frame(7, episode), &never).unwrap();
    }
    tell("sent all");
    hear();
}

/// So large that nearly all of the child's time goes into copying a frame into a loan.
const LARGE: usize = 1 << 20;

#[test]
fn child_sends_large_frames_for_ever() {
    let Some(space) = parents_run() else { return };
    let mut sender = EpisodeSender::open(&space, LARGE, PATIENCE).unwrap();
    let mut frames: Vec<_> = (0..PATTERNS).map(|episode| frame_of(7, episode, LARGE)).collect();
    for episode in 0.. {
        let frame = &mut frames[(episode % PATTERNS) as usize];
        frame.header.episode = episode;
        sender.send(frame, &never).unwrap();
    }
}

#[test]
fn child_learns_nothing() {
    let Some(space) = parents_run() else { return };
    let _receiver = EpisodeReceiver::create(&space, limits(2, 2)).unwrap();
    tell("ready");
    hear();
}

#[test]
fn a_killed_sender_is_reaped_its_place_is_free_and_what_it_delivered_arrives() {
    let run = Run::new();
    let mut receiver = run.receiver(limits(1, 4));
    let mut child = Child::start(&run, "child_sends_three_and_stays");
    child.expect("sent all");
    child.kill();

    let error = EpisodeSender::open(&run.space, PAYLOAD_LEN, PATIENCE).unwrap_err();
    assert!(matches!(error, OpenError::NoPlace { .. }), "{error}");
    // The receiver has not looked once since the sender came: reaping has to connect first.
    assert_eq!(receiver.reap_dead().unwrap(), REAPED_ONE);
    let mut sender = run.sender();
    assert_eq!(drain(&mut receiver), [(7, 0), (7, 1), (7, 2)]);
    sender.send(&frame(8, 0), &never).unwrap();
    assert_eq!(drain(&mut receiver), [(8, 0)]);
    assert_eq!(receiver.reap_dead().unwrap(), Reaped::default());
}

#[test]
fn senders_killed_while_they_copy_cost_nothing_but_the_frame() {
    let run = Run::new();
    let limits = Limits { payload_len: LARGE, ..limits(1, 3) };
    let mut receiver = run.receiver(limits);
    for round in 0..8 {
        let child = Child::start(&run, "child_sends_large_frames_for_ever");
        let mut seen = 0;
        while seen < 100 + 7 * round {
            // No more than a glance, so that the child never waits for a place but copies.
            assert_eq!(next(&mut receiver).header().episode, seen);
            seen += 1;
        }
        child.kill();
        // What was on the way arrives, in order and whole, and then nothing.
        for arrived in drain(&mut receiver) {
            assert_eq!(arrived, (7, seen));
            seen += 1;
        }
        // Else the next has no place.
        assert_eq!(receiver.reap_dead().unwrap(), REAPED_ONE);
    }
    assert_eq!(drain(&mut receiver), []);
}

#[test]
fn a_killed_learner_does_not_block_senders() {
    let run = Run::new();
    let mut child = Child::start(&run, "child_learns_nothing");
    child.expect("ready");
    let mut sender = run.sender();
    for episode in 0..2 {
        sender.send(&frame(0, episode), &never).unwrap();
    }
    let blocked = || true;
    assert!(matches!(sender.send(&frame(0, 2), &blocked), Err(SendError::GaveUp { .. })));
    child.kill();
    assert_eq!(sender.reap_dead().unwrap(), REAPED_ONE);
    assert!(matches!(sender.send(&frame(0, 2), &blocked), Err(SendError::GaveUp { .. })));

    // The next learner gets what is sent from now on. What lay in the dead one's queue is the ledger's to repeat.
    let mut receiver = run.receiver(limits(2, 2));
    sender.send(&frame(0, 2), &never).unwrap();
    assert_eq!(drain(&mut receiver), [(0, 2)]);
}

#[test]
fn a_waiting_sender_reaps_the_learner_it_waits_for() {
    let run = Run::new();
    let mut child = Child::start(&run, "child_learns_nothing");
    child.expect("ready");
    let mut sender = run.sender();
    for episode in 0..2 {
        sender.send(&frame(0, episode), &never).unwrap();
    }
    assert_eq!(node_directories(&run).len(), 2);
    child.kill();
    let learner_is_gone = || node_directories(&run).len() == 1;
    let outcome = sender.send(&frame(0, 2), &learner_is_gone);
    assert!(matches!(outcome, Err(SendError::GaveUp { .. })), "{outcome:?}");
}

#[test]
fn a_learner_started_after_a_killed_one_takes_over_its_senders() {
    let run = Run::new();
    let mut child = Child::start(&run, "child_learns_nothing");
    child.expect("ready");
    let mut sender = run.sender();
    child.kill();
    let mut receiver = run.receiver(limits(2, 2));
    sender.send(&frame(0, 0), &never).unwrap();
    assert_eq!(identify(&next(&mut receiver)), (0, 0));
}

#[test]
fn a_learners_place_that_cannot_be_freed_is_told_from_another_learner() {
    let run = Run::new();
    let mut child = Child::start(&run, "child_learns_nothing");
    child.expect("ready");
    let of_child = node_directories(&run);
    let sender = run.sender();
    child.kill();
    // What a reaper does first. Killed here, it leaves a port that no other reaper will remove.
    let tags = files(&of_child[0]).into_iter().filter(|path| has_extension(path, "port_tag"));
    tags.for_each(|path| std::fs::remove_file(path).unwrap());

    let error = EpisodeReceiver::create(&run.space, limits(2, 2)).unwrap_err();
    assert!(matches!(error, CreateError::StalePlace { .. }), "{error}");
    drop(sender);
    let mut receiver = run.receiver(limits(2, 2));
    run.sender();
    assert_eq!(drain(&mut receiver), []);
}

#[test]
fn what_a_learner_killed_while_it_created_the_service_has_left_is_no_obstacle() {
    let run = Run::new();
    let services = run.space.directory().join("services");
    let receiver = run.receiver(limits(1, 2));
    let [service] = &files(&services)[..] else {
        unreachable!("one service");
    };
    drop(receiver);
    // Such a file is there, empty and not yet read-only, until all the rest is.
    std::fs::write(service, "").unwrap();

    let mut receiver = run.receiver(limits(1, 2));
    run.sender();
    assert_eq!(drain(&mut receiver), []);
}

#[test]
fn a_sender_that_leaves_before_the_learner_has_looked_takes_its_frames_along() {
    let run = Run::new();
    let mut receiver = run.receiver(limits(1, 4));
    let mut child = Child::start(&run, "child_sends_three_and_stays");
    child.expect("sent all");
    child.say("leave");
    child.finish();
    assert_eq!(drain(&mut receiver), [], "if this has changed, leaving need not be a conversation any more");
}

#[test]
fn a_sender_that_stays_until_the_learner_has_answered_loses_nothing() {
    let run = Run::new();
    let mut receiver = run.receiver(limits(1, 4));
    let mut child = Child::start(&run, "child_sends_three_and_stays");
    child.expect("sent all");
    let arrived: Vec<_> = (0..3).map(|_| identify(&next(&mut receiver))).collect();
    child.say("all three have arrived");
    child.finish();
    assert_eq!(arrived, [(7, 0), (7, 1), (7, 2)]);
    assert_eq!(drain(&mut receiver), []);
}

#[test]
fn once_the_learner_has_looked_frames_outlive_their_sender() {
    let run = Run::new();
    let mut receiver = run.receiver(limits(1, 4));
    let mut child = Child::start(&run, "child_sends_three_and_stays");
    child.expect("sent all");
    while !receiver.wait(PATIENCE).unwrap() {}
    child.say("leave");
    child.finish();
    assert_eq!(drain(&mut receiver), [(7, 0), (7, 1), (7, 2)]);
}

#[test]
fn nothing_is_left_of_a_run_whose_processes_were_all_killed() {
    let run = Run::new();
    let mut learner = Child::start(&run, "child_learns_nothing");
    learner.expect("ready");
    let mut sender = run.sender();
    sender.send(&frame(0, 0), &never).unwrap();
    let actors = [(); 1].map(|()| Child::start(&run, "child_sends_three_and_stays"));
    // It has a place, and waits for another in the learner's queue.
    while node_directories(&run).len() < 3 {
        std::thread::yield_now();
    }
    learner.kill();
    actors.into_iter().for_each(Child::kill);
    drop(sender);
    let left = run.space.leftovers().unwrap();
    assert!(left.iter().any(|path| path.starts_with("/dev/shm")));
    run.space.remove().unwrap();
    assert_eq!(run.space.leftovers().unwrap(), Vec::<PathBuf>::new());
}

#[test]
fn a_dead_node_without_details_is_passed_over_and_goes_with_the_run() {
    let run = Run::new();
    let mut receiver = run.receiver(limits(2, 4));
    let before = node_directories(&run);
    let mut child = Child::start(&run, "child_sends_three_and_stays");
    child.expect("sent all");
    child.kill();
    let of_child = node_directories(&run).into_iter().find(|path| !before.contains(path)).unwrap();
    let details = files(&of_child).into_iter().find(|path| has_extension(path, "details"));
    std::fs::remove_file(details.unwrap()).unwrap();

    assert_eq!(receiver.reap_dead().unwrap(), Reaped::default());
    assert_eq!(drain(&mut receiver), [(7, 0), (7, 1), (7, 2)]);
    // That nothing stays is checked where the run ends.
}

/// One directory for every node that lives or was killed.
fn node_directories(run: &Run) -> Vec<PathBuf> {
    files(&run.space.directory().join("nodes")).into_iter().filter(|path| path.is_dir()).collect()
}

fn has_extension(path: &Path, extension: &str) -> bool {
    path.extension().is_some_and(|found| found == extension)
}

fn files(directory: &Path) -> Vec<PathBuf> {
    let entries = std::fs::read_dir(directory).unwrap();
    entries.map(|entry| entry.unwrap().path()).collect()
}
