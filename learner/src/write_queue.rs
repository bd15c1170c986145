//! What waits to be written. A disk may be slower than training for a while, or for ever: neither may fill the memory.
//!
//! One state waits at most. A newer one takes the place of an older that the writer has not begun with: it holds all
//! that the older held, and those that waited for the older are answered by it. Episodes wait in their order, at most
//! twice as many as replay holds; beyond that training waits for the disk. What is trained does not depend on any of
//! it: only which checkpoints there are does.

use crate::{checkpoint::TrainingState, writer::Written};
use rit_episode::Episode;
use std::{
    collections::VecDeque,
    sync::{Arc, Condvar, Mutex, MutexGuard, PoisonError},
};
use tokio::sync::oneshot;

/// A state to be written, and who wants to know of it.
#[derive(Debug)]
pub struct StateToWrite {
    /// The state.
    pub state: Box<TrainingState>,
    /// Answered when it is on disk, or why it is not.
    pub answers: Vec<oneshot::Sender<Written>>,
}

/// What the writer is given, in order.
#[derive(Debug)]
pub enum ToWrite {
    /// The next episode of replay.
    Episode(Arc<Episode>),
    /// A checkpoint.
    Checkpoint(StateToWrite),
}

#[derive(Debug, Default)]
struct Waiting {
    queue: VecDeque<ToWrite>,
    episodes: usize,
    /// Episodes that may wait.
    episodes_max: usize,
    /// Nothing is given any more, or the writer is gone.
    closed: bool,
}

#[derive(Debug, Default)]
struct Shared {
    waiting: Mutex<Waiting>,
    changed: Condvar,
}

impl Shared {
    fn lock(&self) -> MutexGuard<'_, Waiting> {
        // Nothing that could panic happens under the lock; what it guards is whole in any case.
        self.waiting.lock().unwrap_or_else(PoisonError::into_inner)
    }

    fn close(&self) {
        self.lock().closed = true;
        self.changed.notify_all();
    }
}

/// The trainer's end.
#[derive(Debug)]
pub struct WriteQueue(Arc<Shared>);

/// The writer's end.
#[derive(Debug)]
pub struct WriteQueueReader(Arc<Shared>);

/// A queue for a replay of so many episodes.
pub fn write_queue(replay_episodes: usize) -> (WriteQueue, WriteQueueReader) {
    let episodes_max = replay_episodes.max(1).saturating_mul(2);
    let waiting = Mutex::new(Waiting { episodes_max, ..Waiting::default() });
    let shared = Arc::new(Shared { waiting, changed: Condvar::new() });
    (WriteQueue(Arc::clone(&shared)), WriteQueueReader(shared))
}

impl WriteQueue {
    /// Adds an episode, when there is room. Without a writer it is dropped; checkpoints say so.
    pub fn episode(&self, episode: Arc<Episode>) {
        let mut waiting = self.0.lock();
        while waiting.episodes >= waiting.episodes_max && !waiting.closed {
            waiting = self.0.changed.wait(waiting).unwrap_or_else(PoisonError::into_inner);
        }
        if !waiting.closed {
            waiting.queue.push_back(ToWrite::Episode(episode));
            waiting.episodes += 1;
            self.0.changed.notify_all();
        }
    }

    /// Adds a state in place of one that waits. Without a writer the answer is dropped, which tells those that wait.
    pub fn checkpoint(&self, state: Box<TrainingState>, answer: Option<oneshot::Sender<Written>>) {
        let mut waiting = self.0.lock();
        if waiting.closed {
            return;
        }
        let mut answers = Vec::new();
        let older = waiting.queue.iter().position(|item| matches!(item, ToWrite::Checkpoint(_)));
        if let Some(ToWrite::Checkpoint(older)) = older.and_then(|older| waiting.queue.remove(older)) {
            answers = older.answers;
        }
        answers.extend(answer);
        waiting.queue.push_back(ToWrite::Checkpoint(StateToWrite { state, answers }));
        self.0.changed.notify_all();
    }
}

impl WriteQueue {
    /// Whether the writer has gone: it takes nothing any more.
    pub fn is_closed(&self) -> bool {
        self.0.lock().closed
    }
}

impl Drop for WriteQueue {
    fn drop(&mut self) {
        self.0.close();
    }
}

impl WriteQueueReader {
    /// The next thing to write; `None` when all is written and nothing more will come.
    pub fn next(&self) -> Option<ToWrite> {
        let mut waiting = self.0.lock();
        loop {
            if let Some(next) = waiting.queue.pop_front() {
                waiting.episodes -= usize::from(matches!(next, ToWrite::Episode(_)));
                self.0.changed.notify_all();
                return Some(next);
            }
            if waiting.closed {
                return None;
            }
            waiting = self.0.changed.wait(waiting).unwrap_or_else(PoisonError::into_inner);
        }
    }
}

impl Drop for WriteQueueReader {
    fn drop(&mut self) {
        let mut waiting = self.0.lock();
        // Those that wait for a state are told by this.
        waiting.queue.clear();
        waiting.closed = true;
        self.0.changed.notify_all();
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::checkpoint::Manifest;
    use rit_env::{
        Embedded, Script, Split, TaskSet,
        rollout::{Job, Rollout},
    };
    use rit_episode::{Choice, RunSeed};
    use rit_record::Progress;

    fn episode() -> Arc<Episode> {
        let tasks = TaskSet::MatrixGame.tasks(Split::Training);
        let mut rollout = Rollout::new(tasks, Arc::new(Embedded::default()), RunSeed(3), true);
        let job = Job { number: 0, weights_version: 0, choice: Choice::EpsilonGreedy(1.0), task: None };
        Arc::new(rollout.roll(&mut Script::Random, &[job]).swap_remove(0).unwrap())
    }

    fn state(env_steps: u64) -> Box<TrainingState> {
        let progress = Progress { env_steps, ..Progress::default() };
        let manifest = Manifest { progress, ..Manifest::default() };
        Box::new(TrainingState { params: vec![], best: None, learner: vec![], snapshots: vec![], manifest })
    }

    /// What waits, in order: an episode, or a state's steps and how many wait for it.
    fn drain(reader: &WriteQueueReader, count: usize) -> Vec<Option<(u64, usize)>> {
        let next = |item: ToWrite| match item {
            ToWrite::Episode(_) => None,
            ToWrite::Checkpoint(StateToWrite { state, answers }) => {
                Some((state.manifest.progress.env_steps, answers.len()))
            }
        };
        (0..count).map(|_| next(reader.next().unwrap())).collect()
    }

    #[test]
    fn one_state_waits_and_answers_for_those_it_replaces() {
        let (queue, reader) = write_queue(10);
        queue.episode(episode());
        for env_steps in 1..=1000 {
            let answer = (env_steps % 500 == 0).then(|| oneshot::channel().0);
            queue.checkpoint(state(env_steps), answer);
            if env_steps == 600 {
                queue.episode(episode());
            }
        }
        assert_eq!(drain(&reader, 3), [None, None, Some((1000, 2))]);
        queue.checkpoint(state(2000), None);
        drop(queue);
        assert_eq!(drain(&reader, 1), [Some((2000, 0))], "what waits at the end is written");
        assert!(reader.next().is_none());
    }

    #[test]
    fn training_waits_for_the_disk_when_twice_as_many_episodes_wait_as_replay_holds() {
        let (queue, reader) = write_queue(2);
        let episode = episode();
        (0..4).for_each(|_| queue.episode(Arc::clone(&episode)));
        std::thread::scope(|scope| {
            let fifth = scope.spawn(|| queue.episode(Arc::clone(&episode)));
            assert_eq!(drain(&reader, 5), [None; 5], "the fifth comes once there is room");
            fifth.join().unwrap();
        });
        assert_eq!(Arc::strong_count(&episode), 1);
    }

    #[tokio::test]
    async fn those_that_wait_are_told_that_the_writer_has_gone() {
        let (queue, reader) = write_queue(1);
        let (answer, answered) = oneshot::channel();
        queue.checkpoint(state(1), Some(answer));
        assert!(!queue.is_closed());
        drop(reader);
        assert!(answered.await.is_err() && queue.is_closed());
        let (answer, answered) = oneshot::channel();
        queue.checkpoint(state(2), Some(answer));
        assert!(answered.await.is_err());
        (0..9).for_each(|_| queue.episode(episode()));
    }
}
