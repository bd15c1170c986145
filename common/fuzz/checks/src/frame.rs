//! Frames as they lie in shared memory: see [`rit_episode::wire`].

use bytemuck::Zeroable as _;
use rit_env::{
    Embedded, Script, Split, TaskSet,
    rollout::{Job, Rollout},
};
use rit_episode::{
    Choice, Dims, Episode, RunSeed,
    wire::{self, Expected, Frame, Header, PayloadLayout, RunId, TaskSize},
};
use std::sync::Arc;

/// The first byte of an input: length and checksum are made right before the frame is read.
pub const MENDED: u8 = 1;
/// The first byte of an input: a frame of [`padded_run`], not of [`matrix_run`].
pub const PADDED: u8 = 2;

const RUN: RunId = *b"a run's sixteen.";

/// The multi matrix game: no padding anywhere.
pub fn matrix_run() -> Expected {
    let tasks = TaskSet::MatrixGame.tasks(Split::Training);
    Expected {
        run_id: RUN,
        layout: PayloadLayout::new(TaskSet::MatrixGame.dims()),
        tasks: tasks.into_iter().map(rit_env::Task::size).collect(),
    }
}

/// Tasks of several sizes: padding of agents, of other entities, of steps.
pub fn padded_run() -> Expected {
    let dims = Dims { entity_dim: 5, n_actions: 3, agents_max: 4, entities_max: 7, steps_max: 6 };
    let size = |n_agents, n_entities| TaskSize { n_agents, n_entities };
    let tasks = vec![size(2, 4), size(4, 7), size(1, 1), size(3, 3)];
    Expected { run_id: RUN, layout: PayloadLayout::new(dims), tasks }
}

/// Reads a frame, and says whether it was accepted. What is accepted must be what a sender would have sent: padding
/// it again and reading that gives the same episode.
///
/// # Panics
/// When it does not.
pub fn check(input: &[u8]) -> bool {
    let Some((&how, frame)) = input.split_first() else { return false };
    let Some((header, payload)) = frame.split_at_checked(size_of::<Header>()) else { return false };
    let expected = if how & PADDED == 0 { matrix_run() } else { padded_run() };
    let mut header: Header = bytemuck::pod_read_unaligned(header);
    let mut payload = payload.to_vec();
    if how & MENDED != 0 {
        payload.resize(expected.layout.len(), 0);
        mend(&mut header, &payload);
    }
    let Ok(episode) = wire::decode(&header, &payload, &expected) else { return false };
    let mut again = Frame::new(&expected.layout);
    let encoded = wire::encode(&episode, &expected.layout, RUN, header.actor, &mut again);
    assert_eq!(encoded, Ok(()), "what was accepted fits");
    assert_eq!(wire::decode(&again.header, &again.payload, &expected), Ok(episode));
    true
}

/// Makes length and checksum what they have to be.
pub(crate) fn mend(header: &mut Header, payload: &[u8]) {
    (header.payload_len, header.checksum) = (payload.len() as u64, 0);
    let mut crc = crc32fast::Hasher::new();
    crc.update(bytemuck::bytes_of(header));
    crc.update(payload);
    header.checksum = crc.finalize();
}

/// Whole inputs to begin from: rolled episodes of the matrix game, one padded episode a task size.
pub fn seeds() -> Vec<(String, Vec<u8>)> {
    let mut seeds = Vec::new();
    for how in [0, MENDED] {
        for episode in matrix_episodes(4) {
            seeds.push((format!("matrix-{}-{how}", episode.number), input(how, &episode, &matrix_run())));
        }
    }
    for (task, size) in padded_run().tasks.into_iter().enumerate() {
        let how = MENDED | PADDED;
        seeds.push((format!("padded-{task}"), input(how, &padded_episode(task, size), &padded_run())));
    }
    seeds
}

/// Episodes of the multi matrix game, from number 0 on.
pub(crate) fn matrix_episodes(count: u64) -> Vec<Episode> {
    let tasks = TaskSet::MatrixGame.tasks(Split::Training);
    let mut rollout = Rollout::new(tasks, Arc::new(Embedded::default()), RunSeed(3), true);
    let jobs: Vec<Job> = (0..count)
        .map(|number| Job { number, weights_version: 0, choice: Choice::EpsilonGreedy(1.0), task: None })
        .collect();
    rollout.roll(&mut Script::Random, &jobs).into_iter().flatten().collect()
}

fn padded_episode(task: usize, TaskSize { n_agents, n_entities }: TaskSize) -> Episode {
    let steps = task + 1;
    Episode {
        number: task as u64,
        weights_version: 7,
        task,
        n_agents,
        n_entities,
        decision_order: (0..n_agents as u8).rev().collect(),
        entities: (0..(steps + 1) * n_entities * 5).map(|i| i as f32 / 8.0).collect(),
        observable: vec![1; (steps + 1) * n_agents * n_entities],
        available: vec![1; (steps + 1) * n_agents * 3],
        actions: (0..steps * n_agents).map(|i| (i % 3) as u8).collect(),
        rewards: (0..steps).map(|i| -(i as f32)).collect(),
        shaping: vec![0.5; steps],
        end: if task.is_multiple_of(2) { rit_episode::End::Terminated } else { rit_episode::End::Truncated },
        won: task == 1,
    }
}

fn input(how: u8, episode: &Episode, expected: &Expected) -> Vec<u8> {
    let mut frame = Frame { header: Header::zeroed(), payload: vec![] };
    // The episodes above are of the sizes of their run; were one not, its seed would be refused and seen.
    let _ = wire::encode(episode, &expected.layout, RUN, 0, &mut frame);
    [&[how], bytemuck::bytes_of(&frame.header), &frame.payload].concat()
}
