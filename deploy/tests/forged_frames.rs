//! What arrives in shared memory is not trusted: a forged frame is counted and changes nothing.
#![allow(clippy::unwrap_used, clippy::panic, clippy::print_stdout, reason = "helpers of tests are tests too")]

mod common;

use common::RunFolder;
use rit_config::RunDir;
use rit_env::{
    Embedded, Script, Split, TaskSet,
    rollout::{Job, Rollout},
};
use rit_episode::{
    Choice, RunSeed,
    wire::{self, Frame, PayloadLayout},
};
use rit_ipc::{EpisodeSender, RunSpace};
use std::{fs, path::Path, sync::Arc, time::Duration};

#[test]
fn forged_frames_are_counted_and_never_reach_replay() {
    const RUN: &[&str] = &["matrix-game", "--steps", "2000", "--seed", "3", "--actors", "1"];
    let undisturbed = RunFolder::new().train(RUN);

    let folder = RunFolder::new();
    let mut train = folder.start(RUN);
    train.wait_for("training", |status| status["updates"].as_u64() > Some(0));
    let (run_dir, _) = RunDir::open(&folder.run_dir()).unwrap();
    let place = fs::read_to_string(run_dir.shared_memory()).unwrap();
    let space = RunSpace::new(Path::new(place.trim_end())).unwrap();
    let layout = PayloadLayout::new(TaskSet::MatrixGame.dims());
    let mut sender = EpisodeSender::open(&space, layout.len(), Duration::from_secs(5)).unwrap();
    let mut send = |frame: &Frame| sender.send(frame, &|| false).unwrap();

    // Not a frame at all; a whole episode that was never handed out; the same with one bit changed.
    send(&Frame::new(&layout));
    let tasks = TaskSet::MatrixGame.tasks(Split::Training);
    let mut rollout = Rollout::new(tasks, Arc::new(Embedded::default()), RunSeed(9), true);
    let job = Job { number: 1_000_000, weights_version: 0, choice: Choice::EpsilonGreedy(1.0), task: None };
    let episode = rollout.roll(&mut Script::Random, &[job]).remove(0).unwrap();
    let mut frame = Frame::new(&layout);
    wire::encode(&episode, &layout, run_dir.run_id(), 0, &mut frame).unwrap();
    send(&frame);
    frame.payload[3] ^= 1;
    send(&frame);

    let status = train.wait_for("the refusals", |status| {
        let refused = status["ledger"]["frames_refused"].as_object().unwrap();
        refused.values().filter_map(serde_json::Value::as_u64).sum::<u64>() == 3
    });
    let refused = &status["ledger"]["frames_refused"];
    assert_eq!(
        (&refused["magic"], &refused["not_outstanding"], &refused["checksum"]),
        (&1.into(), &1.into(), &1.into())
    );
    assert_eq!(train.finish()["weights_digest"], undisturbed["weights_digest"]);
}
