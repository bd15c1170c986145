//! `rit.v1.Control`: what people and scripts ask of a running learner.

use crate::{
    coordinator::{Control, Event},
    evaluation::{Evaluator, TaskResult},
    trainer::{Checkpointed, evaluation_seed},
    weights::WeightsBoard,
};
use rit_algo::{Acting, Rit};
use rit_config::Config;
use rit_episode::RunSeed;
use rit_proto::v1::{self, control_server};
use std::sync::Arc;
use tokio::sync::{Semaphore, mpsc, oneshot};
use tonic::{Request, Response, Status};

/// `rit.v1.Control`.
#[derive(Clone, Debug)]
pub struct ControlService {
    events: mpsc::Sender<Event>,
    board: Arc<WeightsBoard>,
    config: Arc<Config>,
    rit: Arc<Rit>,
    /// One evaluation at a time: training goes on beside it.
    evaluations: Arc<Semaphore>,
}

impl ControlService {
    /// Speaks to the coordinator by `events`, and evaluates the weights on the board.
    pub fn new(
        events: mpsc::Sender<Event>,
        board: Arc<WeightsBoard>,
        config: Arc<Config>,
        rit: Arc<Rit>,
    ) -> Self {
        Self { events, board, config, rit, evaluations: Arc::new(Semaphore::new(1)) }
    }

    async fn ask<T>(&self, question: impl FnOnce(oneshot::Sender<T>) -> Control) -> Result<T, Status> {
        let (answer, answered) = oneshot::channel();
        let over = || Status::unavailable("the run is over");
        self.events.send(Event::Control(question(answer))).await.map_err(|_| over())?;
        answered.await.map_err(|_| over())
    }
}

#[tonic::async_trait]
impl control_server::Control for ControlService {
    async fn status(&self, _: Request<v1::StatusRequest>) -> Result<Response<v1::RunStatus>, Status> {
        self.ask(Control::Status).await.map(Response::new)
    }

    async fn pause(&self, _: Request<v1::PauseRequest>) -> Result<Response<v1::RunStatus>, Status> {
        self.ask(Control::Pause).await.map(Response::new)
    }

    async fn resume(&self, _: Request<v1::ResumeRequest>) -> Result<Response<v1::RunStatus>, Status> {
        self.ask(Control::Resume).await.map(Response::new)
    }

    async fn stop(&self, _: Request<v1::StopRequest>) -> Result<Response<v1::RunStatus>, Status> {
        self.ask(Control::Stop).await.map(Response::new)
    }

    async fn checkpoint(
        &self,
        _: Request<v1::CheckpointRequest>,
    ) -> Result<Response<v1::CheckpointResponse>, Status> {
        let Checkpointed { progress, weights_digest, written } = self.ask(Control::Checkpoint).await?;
        let written = written.await.map_err(|_| Status::unavailable("the run is over"))?;
        let path = written.map_err(|error| Status::internal(error.to_string()))?;
        let (path, env_steps) = (path.display().to_string(), progress.env_steps);
        Ok(Response::new(v1::CheckpointResponse { path, env_steps, weights_digest }))
    }

    async fn evaluate(
        &self,
        request: Request<v1::EvaluateRequest>,
    ) -> Result<Response<v1::Evaluation>, Status> {
        let v1::EvaluateRequest { tasks, episodes, seed } = request.into_inner();
        let evaluator = Evaluator::new(&self.config);
        let invalid = |error: &dyn std::fmt::Display| Status::invalid_argument(error.to_string());
        let tasks = evaluator.tasks(&tasks).map_err(|error| invalid(&error))?;
        if tasks.is_empty() {
            return Err(invalid(&format!("{} has no such tasks", self.config.environment.task_set)));
        }
        let episodes = match episodes as usize {
            0 => self.config.evaluation.episodes,
            episodes => episodes,
        };
        let seed = seed.map_or_else(|| evaluation_seed(&self.config), RunSeed);
        let _one_at_a_time = self.evaluations.acquire().await.map_err(|error| invalid(&error))?;
        let (snapshot, rit) = (self.board.newest(), Arc::clone(&self.rit));
        let evaluation = tokio::task::spawn_blocking(move || {
            let mut acting = Acting::new(rit, &snapshot.to_params());
            let results = evaluator.evaluate(&mut acting, &tasks, episodes, seed);
            v1::Evaluation {
                env_steps: snapshot.env_steps,
                weights_version: snapshot.version,
                tasks: results.iter().map(TaskResult::to_message).collect(),
            }
        });
        let failed = |error| Status::internal(format!("the evaluation failed: {error}"));
        evaluation.await.map(Response::new).map_err(failed)
    }
}
