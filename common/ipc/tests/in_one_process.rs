//! Both ends in one process: order, back-pressure, giving up, and what is refused.

#![allow(clippy::unwrap_used, unreachable_pub)]

mod common;

use common::{PATIENCE, PAYLOAD_LEN, Run, drain, frame, frame_of, identify, limits, never, next};
use rit_episode::wire::{self, ALIGNMENT, Expected, Frame, PayloadLayout, TaskSize};
use rit_episode::{Dims, End, EpisodeBuilder, Observation};
use rit_ipc::{
    CreateError, DirectoryError, EpisodeReceiver, EpisodeSender, Limits, OpenError, RunSpace, RunSpaceError,
    SendError,
};
use std::os::unix::fs::PermissionsExt as _;
use std::path::Path;
use std::sync::Barrier;
use std::sync::atomic::{AtomicBool, AtomicU32, Ordering::SeqCst};
use std::time::Duration;

#[test]
fn an_episode_comes_out_as_it_went_in() {
    let dims = Dims { entity_dim: 3, n_actions: 2, agents_max: 2, entities_max: 5, steps_max: 4 };
    let mut observation = Observation::new(2, 3, dims.entity_dim, dims.n_actions);
    observation.entity_mut(1).fill(0.5);
    observation.available_mut(0).fill(1);
    observation.available_mut(1).fill(1);
    let mut builder = EpisodeBuilder::new(17, 3, 0, vec![1, 0], &observation);
    builder.step(&[0, 1], -1.5, 0.0, &observation);
    let episode = builder.finish(End::Terminated, true);
    let layout = PayloadLayout::new(dims);
    let mut sent = Frame::new(&layout);
    wire::encode(&episode, &layout, [7; 16], 1, &mut sent).unwrap();

    let run = Run::new();
    let mut receiver = run.receiver(Limits::new(layout.len(), 1));
    let mut sender = EpisodeSender::open(&run.space, layout.len(), PATIENCE).unwrap();
    sender.send(&sent, &never).unwrap();
    let received = next(&mut receiver);

    assert_eq!(received.header(), &sent.header);
    assert_eq!(received.payload(), &sent.payload);
    assert_eq!(received.payload().as_ptr().align_offset(ALIGNMENT), 0);
    let expected = Expected { run_id: [7; 16], layout, tasks: vec![TaskSize { n_agents: 2, n_entities: 3 }] };
    assert_eq!(wire::decode(received.header(), received.payload(), &expected), Ok(episode));
}

#[test]
fn other_users_may_not_look_into_shared_memory() {
    let run = Run::new();
    let mut receiver = run.receiver(limits(1, 2));
    let mut sender = run.sender();
    sender.send(&frame(1, 2), &never).unwrap();
    next(&mut receiver);
    let files = run.space.leftovers().unwrap();
    // At least a data segment, the bell, and the one that iceoryx2 would leave open.
    assert!(files.iter().filter(|path| path.starts_with("/dev/shm")).count() >= 3, "{files:?}");
    for path in files.iter().filter(|path| path.starts_with("/dev/shm")) {
        let mode = std::fs::metadata(path).unwrap().permissions().mode() & 0o777;
        assert_eq!(mode, 0o600, "{} has mode {mode:o}", path.display());
    }
    let folder = std::fs::metadata(run.space.directory()).unwrap().permissions().mode() & 0o777;
    assert_eq!(folder, 0o700, "what lies in it is out of others' reach");
}

#[test]
fn many_frames_through_few_places_arrive_whole_and_in_each_senders_order() {
    const SENDERS: u32 = 3;
    const FRAMES: u64 = 400;
    let run = Run::new();
    let mut receiver = run.receiver(limits(SENDERS as usize, 2));
    let mut expected = [0; SENDERS as usize];
    let all_received = &Barrier::new(SENDERS as usize + 1);
    std::thread::scope(|scope| {
        for actor in 0..SENDERS {
            let mut sender = run.sender();
            scope.spawn(move || {
                for episode in 0..FRAMES {
                    sender.send(&frame(actor, episode), &never).unwrap();
                }
                all_received.wait();
            });
        }
        for _ in 0..u64::from(SENDERS) * FRAMES {
            // Slow: every byte is looked at, while the sender's place is held.
            let (actor, episode) = identify(&next(&mut receiver));
            assert_eq!(episode, expected[actor as usize]);
            expected[actor as usize] += 1;
        }
        all_received.wait();
    });
    assert_eq!(expected, [FRAMES; SENDERS as usize]);
    assert!(receiver.receive().unwrap().is_none());
}

#[test]
fn a_send_without_a_learner_waits_and_then_delivers() {
    let run = Run::new();
    let former = run.receiver(limits(1, 2));
    let mut sender = run.sender();
    drop(former);
    let asked = AtomicU32::new(0);
    std::thread::scope(|scope| {
        scope.spawn(|| {
            let count = || asked.fetch_add(1, SeqCst) == u32::MAX;
            sender.send(&frame(0, 5), &count).unwrap();
        });
        // It waits.
        while asked.load(SeqCst) < 3 {
            std::thread::yield_now();
        }
        let mut receiver = run.receiver(limits(1, 2));
        assert_eq!(identify(&next(&mut receiver)), (0, 5));
    });
}

#[test]
fn a_blocked_send_can_be_given_up_and_leaves_no_trace() {
    let run = Run::new();
    let mut receiver = run.receiver(limits(1, 2));
    let mut sender = run.sender();
    for episode in 0..2 {
        let at_once = || unreachable!("there is room");
        sender.send(&frame(0, episode), &at_once).unwrap();
    }
    let asked = AtomicU32::new(0);
    let third_time = || asked.fetch_add(1, SeqCst) == 2;
    let error = sender.send(&frame(0, 99), &third_time).unwrap_err();
    assert!(matches!(error, SendError::GaveUp { .. }), "{error}");
    assert_eq!(drain(&mut receiver), [(0, 0), (0, 1)]);
    sender.send(&frame(0, 2), &never).unwrap();
    assert_eq!(drain(&mut receiver), [(0, 2)]);
}

#[test]
fn a_frame_held_is_a_place_taken_and_may_outlive_the_receiver() {
    let run = Run::new();
    let mut receiver = run.receiver(limits(1, 2));
    let mut sender = run.sender();
    let at_once = || true;
    for episode in 0..2 {
        sender.send(&frame(0, episode), &at_once).unwrap();
    }
    let held = [next(&mut receiver), next(&mut receiver)];
    assert!(sender.send(&frame(0, 2), &at_once).is_err());
    let [first, second] = held;
    drop(first);
    sender.send(&frame(0, 2), &at_once).unwrap();
    drop(receiver);
    let elsewhere = std::thread::spawn(move || identify(&second));
    assert_eq!(elsewhere.join().unwrap(), (0, 1));
}

#[test]
fn a_frame_wakes_a_learner_that_sleeps() {
    let run = Run::new();
    let mut receiver = run.receiver(limits(1, 2));
    let mut sender = run.sender();
    let step = &Barrier::new(2);
    std::thread::scope(|scope| {
        scope.spawn(move || {
            step.wait();
            sender.send(&frame(0, 1), &never).unwrap();
            // Stays until it is received.
            step.wait();
        });
        step.wait();
        while !receiver.wait(PATIENCE).unwrap() {}
        assert_eq!(drain(&mut receiver), [(0, 1)]);
        step.wait();
    });
    assert!(!receiver.wait(Duration::from_millis(1)).unwrap());
}

#[test]
fn two_runs_on_one_machine_do_not_meet() {
    let (here, there) = (Run::new(), Run::new());
    let mut receivers = [here.receiver(limits(1, 2)), there.receiver(limits(1, 2))];
    let mut senders = [here.sender(), there.sender()];
    senders[1].send(&frame(1, 1), &never).unwrap();
    assert_eq!(drain(&mut receivers[0]), []);
    senders[0].send(&frame(0, 0), &never).unwrap();
    assert_eq!(drain(&mut receivers[0]), [(0, 0)]);
    assert_eq!(drain(&mut receivers[1]), [(1, 1)]);

    // Nor does the end of one concern the other.
    here.space.remove().unwrap();
    senders[1].send(&frame(1, 2), &never).unwrap();
    assert_eq!(drain(&mut receivers[1]), [(1, 2)]);
}

#[test]
fn a_sender_without_a_learner_says_so() {
    let run = Run::new();
    let open = || EpisodeSender::open(&run.space, PAYLOAD_LEN, Duration::from_millis(20)).unwrap_err();
    let error = open();
    assert!(matches!(error, OpenError::NoLearner { .. }), "{error}");
    assert!(run.space.leftovers().unwrap().is_empty(), "an early actor leaves nothing behind");

    // Nor when the learner has left, though the place is still there.
    let receiver = run.receiver(limits(2, 2));
    let _sender = run.sender();
    drop(receiver);
    assert!(matches!(open(), OpenError::NoLearner { .. }));
}

#[test]
fn a_sender_waits_for_a_learner_that_comes_late() {
    let run = Run::new();
    let waiting = AtomicBool::new(false);
    std::thread::scope(|scope| {
        let sender = scope.spawn(|| {
            waiting.store(true, SeqCst);
            run.sender()
        });
        while !waiting.load(SeqCst) {
            std::thread::yield_now();
        }
        let mut receiver = run.receiver(limits(1, 2));
        let mut sender = sender.join().unwrap();
        sender.send(&frame(0, 0), &never).unwrap();
        assert_eq!(drain(&mut receiver), [(0, 0)]);
    });
}

#[test]
fn a_sender_without_a_place_says_so_and_a_sender_that_leaves_frees_its_place() {
    let run = Run::new();
    let mut receiver = run.receiver(limits(2, 2));
    let first = run.sender();
    let _second = run.sender();
    let error = EpisodeSender::open(&run.space, PAYLOAD_LEN, PATIENCE).unwrap_err();
    assert!(matches!(error, OpenError::NoPlace { .. }), "{error}");
    drop(first);
    run.sender().send(&frame(3, 3), &never).unwrap();
    assert_eq!(receiver.reap_dead().unwrap().removed, 0);
}

#[test]
fn learner_and_actor_of_different_dims_are_told_apart() {
    let run = Run::new();
    let _receiver = run.receiver(limits(2, 2));
    let error = EpisodeSender::open(&run.space, PAYLOAD_LEN + 8, PATIENCE).unwrap_err();
    assert_eq!(
        error.to_string(),
        "the learner expects payloads of 4096 bytes, this actor's have 4104: give both the same experiment"
    );
    let error = run.sender().send(&frame_of(0, 0, 16), &never).unwrap_err();
    assert_eq!(error, SendError::PayloadLen { found: 16, expected: PAYLOAD_LEN });
    let error = EpisodeReceiver::create(&run.space, Limits::new(13, 1)).unwrap_err();
    assert!(matches!(error, CreateError::Unaligned { payload_len: 13 }), "{error}");
}

#[test]
fn a_second_learner_is_refused() {
    let run = Run::new();
    let mut receiver = run.receiver(limits(1, 2));
    let error = EpisodeReceiver::create(&run.space, limits(1, 2)).unwrap_err();
    assert!(matches!(error, CreateError::AnotherLearner { .. }), "{error}");
    run.sender().send(&frame(0, 0), &never).unwrap();
    drop(receiver.receive().unwrap());
}

#[test]
fn a_learner_of_other_limits_is_refused_while_actors_of_the_former_live() {
    let run = Run::new();
    let receiver = run.receiver(limits(1, 2));
    let sender = run.sender();
    drop(receiver);
    let other = [
        (limits(1, 4), "fewer frames per sender"),
        (limits(9, 2), "fewer senders"),
        (Limits { payload_len: 8, ..limits(1, 2) }, "another payload length"),
    ];
    for (limits, expected) in other {
        let error = EpisodeReceiver::create(&run.space, limits).unwrap_err();
        assert!(matches!(&error, CreateError::OtherLimits { other, .. } if *other == expected), "{error}");
    }
    drop(sender);
    run.receiver(limits(9, 4));
}

#[test]
fn the_longest_directory_works_and_longer_ones_are_refused() {
    let parent = tempfile::tempdir().unwrap();
    let of_length = |length: usize| {
        let name = "x".repeat(length - parent.path().as_os_str().len() - 1);
        RunSpace::new(&parent.path().join(name))
    };
    let RunSpaceError::TooLong { limit, length, .. } = of_length(150).unwrap_err() else {
        unreachable!("150 is too long");
    };
    assert_eq!(length, 150);
    assert!(of_length(limit + 1).is_err());
    let space = of_length(limit).unwrap();
    {
        let mut receiver = EpisodeReceiver::create(&space, limits(1, 2)).unwrap();
        let mut sender = EpisodeSender::open(&space, PAYLOAD_LEN, PATIENCE).unwrap();
        sender.send(&frame(0, 0), &never).unwrap();
        assert_eq!(drain(&mut receiver), [(0, 0)]);
        assert_eq!(receiver.reap_dead().unwrap().removed, 0);
    }
    space.remove().unwrap();
    assert!(space.leftovers().unwrap().is_empty());
}

#[test]
fn directories_that_name_no_place_are_refused() {
    let error = RunSpace::new(Path::new("run")).unwrap_err();
    assert!(matches!(error, RunSpaceError::NotAbsolute { .. }), "{error}");
    let error = RunSpace::new(Path::new("/tmp/a\nb")).unwrap_err();
    assert!(matches!(error, RunSpaceError::Characters { .. }), "{error}");
}

#[test]
fn a_directory_open_to_others_is_neither_used_nor_removed() {
    let parent = tempfile::tempdir().unwrap();
    let directory = parent.path().join("open");
    std::fs::create_dir_all(directory.join("nodes")).unwrap();
    std::fs::set_permissions(&directory, std::fs::Permissions::from_mode(0o755)).unwrap();
    let space = RunSpace::new(&directory).unwrap();
    let created = EpisodeReceiver::create(&space, limits(1, 2)).unwrap_err();
    assert!(matches!(created, CreateError::Directory(DirectoryError::NotPrivate { .. })));
    let opened = EpisodeSender::open(&space, PAYLOAD_LEN, PATIENCE).unwrap_err();
    assert!(matches!(opened, OpenError::Directory(DirectoryError::NotPrivate { .. })));
    assert!(space.remove().is_err());
    assert!(directory.join("nodes").exists());
}

#[test]
fn a_foreign_file_keeps_the_directory() {
    let run = Run::new();
    let receiver = run.receiver(limits(1, 2));
    let socket = run.space.directory().join("control.sock");
    std::fs::write(&socket, "").unwrap();
    drop(receiver);
    run.space.remove().unwrap();
    assert_eq!(run.space.leftovers().unwrap(), [run.space.directory()]);
    std::fs::remove_file(socket).unwrap();
}
