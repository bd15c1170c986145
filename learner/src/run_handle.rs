//! What callers ask of a running learner, whichever way they come: the gRPC service and the web page share it.

use crate::{
    coordinator::{Control, Event},
    evaluation::{Evaluator, TaskResult},
    trainer::{Checkpointed, evaluation_seed},
    weights::{Snapshot, WeightsBoard},
};
use rit_algo::{Acting, Rit};
use rit_config::Config;
use rit_env::{Scene, TaskSet, UnknownName};
use rit_episode::{Episode, RunSeed};
use rit_proto::v1;
use std::sync::Arc;
use tokio::{
    sync::{Semaphore, mpsc, oneshot},
    task::JoinError,
};

/// Why a question has no answer.
#[derive(Debug, thiserror::Error)]
pub enum AskError {
    /// Nobody is there to answer.
    #[error("the run is over")]
    Over,
    /// No such task.
    #[error(transparent)]
    Task(#[from] UnknownName),
    /// A split without tasks.
    #[error("{0} has no such tasks")]
    NoTasks(TaskSet),
    /// The checkpoint was not written.
    #[error("{0}")]
    Checkpoint(String),
    /// The episodes were not rolled to their end.
    #[error("the evaluation failed: {0}")]
    Rollout(#[from] JoinError),
}

/// One greedy episode, and what could be seen of it.
#[derive(Debug)]
pub struct Watched {
    /// The weights that rolled it.
    pub snapshot: Arc<Snapshot>,
    /// What was done and earned.
    pub episode: Episode,
    /// The world at its beginning and after each step; nothing where the entities have no places.
    pub scenes: Vec<Scene>,
}

/// A way to speak to a running learner.
#[derive(Clone, Debug)]
pub struct RunHandle {
    events: mpsc::Sender<Event>,
    board: Arc<WeightsBoard>,
    config: Arc<Config>,
    rit: Arc<Rit>,
    /// One caller's episodes at a time: training goes on beside them.
    rollouts: Arc<Semaphore>,
}

impl RunHandle {
    /// Speaks to the coordinator by `events`, and evaluates the weights on the board.
    pub fn new(
        events: mpsc::Sender<Event>,
        board: Arc<WeightsBoard>,
        config: Arc<Config>,
        rit: Arc<Rit>,
    ) -> Self {
        Self { events, board, config, rit, rollouts: Arc::new(Semaphore::new(1)) }
    }

    /// The run's configuration.
    pub fn config(&self) -> &Config {
        &self.config
    }

    /// Asks the coordinator.
    ///
    /// # Errors
    /// When the run is over.
    pub async fn ask<T>(&self, question: impl FnOnce(oneshot::Sender<T>) -> Control) -> Result<T, AskError> {
        let (answer, answered) = oneshot::channel();
        self.events.send(Event::Control(question(answer))).await.map_err(|_| AskError::Over)?;
        answered.await.map_err(|_| AskError::Over)
    }

    /// Waits until nobody answers any more.
    pub async fn over(&self) {
        self.events.closed().await;
    }

    /// Writes a checkpoint, and answers when it is on disk.
    ///
    /// # Errors
    /// When the run is over or the checkpoint cannot be written.
    pub async fn checkpoint(&self) -> Result<v1::CheckpointResponse, AskError> {
        let Checkpointed { progress, weights_digest, written } = self.ask(Control::Checkpoint).await?;
        let written = written.await.map_err(|_| AskError::Over)?;
        let path = written.map_err(|error| AskError::Checkpoint(error.to_string()))?;
        let (path, env_steps) = (path.display().to_string(), progress.env_steps);
        Ok(v1::CheckpointResponse { path, env_steps, weights_digest })
    }

    /// Greedy episodes with the newest weights, while training goes on.
    ///
    /// # Errors
    /// When there are no such tasks.
    pub async fn evaluate(&self, request: v1::EvaluateRequest) -> Result<v1::Evaluation, AskError> {
        let v1::EvaluateRequest { tasks, episodes, seed } = request;
        let evaluator = Evaluator::new(&self.config);
        let tasks = evaluator.tasks(&tasks)?;
        if tasks.is_empty() {
            return Err(AskError::NoTasks(self.config.environment.task_set));
        }
        let episodes = match episodes as usize {
            0 => self.config.evaluation.episodes,
            episodes => episodes,
        };
        let seed = seed.map_or_else(|| evaluation_seed(&self.config), RunSeed);
        self.roll(move |acting, snapshot| {
            let results = evaluator.evaluate(acting, &tasks, episodes, seed);
            v1::Evaluation {
                env_steps: snapshot.env_steps,
                weights_version: snapshot.version,
                tasks: results.iter().map(TaskResult::to_message).collect(),
            }
        })
        .await
    }

    /// The episode of this number of the run's own evaluation of a task, rolled with the newest weights.
    ///
    /// # Errors
    /// When there is no such task.
    pub async fn watch(&self, task: &str, number: u64) -> Result<Watched, AskError> {
        let evaluator = Evaluator::new(&self.config);
        let task = self.config.environment.task_set.task(task)?;
        let seed = evaluation_seed(&self.config);
        self.roll(move |acting, snapshot| {
            let (mut scenes, one) = (Vec::new(), number..number + 1);
            let mut episodes =
                evaluator.watch(acting, task, one, seed, |_, world| scenes.extend(world.scene()));
            // One number, one episode.
            Watched { snapshot: Arc::clone(snapshot), episode: episodes.swap_remove(0), scenes }
        })
        .await
    }

    /// Rolls with the newest weights on a thread of its own. Whoever asked may go: the next one's turn comes
    /// when the episodes are done all the same.
    async fn roll<T: Send + 'static>(
        &self,
        work: impl FnOnce(&mut Acting, &Arc<Snapshot>) -> T + Send + 'static,
    ) -> Result<T, AskError> {
        let turn = Arc::clone(&self.rollouts).acquire_owned().await.map_err(|_| AskError::Over)?;
        let (snapshot, rit) = (self.board.newest(), Arc::clone(&self.rit));
        let rolled = tokio::task::spawn_blocking(move || {
            let _turn = turn;
            work(&mut Acting::new(rit, &snapshot.to_params()), &snapshot)
        });
        Ok(rolled.await?)
    }
}
