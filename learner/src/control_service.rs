//! `rit.v1.Control`: what people and scripts ask of a running learner.

use crate::{
    coordinator::{Control, Event},
    evaluation::{Evaluator, TaskResult},
    metrics::{Follower, Line},
    trainer::{Checkpointed, evaluation_seed},
    weights::WeightsBoard,
};
use rit_algo::{Acting, Rit};
use rit_config::Config;
use rit_episode::RunSeed;
use rit_proto::v1::{self, control_server};
use std::{pin::Pin, sync::Arc, time::Duration};
use tokio::{
    sync::{Semaphore, mpsc, oneshot},
    time::MissedTickBehavior,
};
use tokio_stream::{Stream, wrappers::ReceiverStream};
use tonic::{Request, Response, Status};

/// Updates that may wait for one reader of metrics.
const METRICS_QUEUE: usize = 16;

/// The shortest time from one status in a stream of metrics to the next.
const STATUS_EVERY_MIN: Duration = Duration::from_millis(50);

/// `rit.v1.Control`.
#[derive(Clone, Debug)]
pub struct ControlService {
    events: mpsc::Sender<Event>,
    board: Arc<WeightsBoard>,
    metrics: Follower,
    config: Arc<Config>,
    rit: Arc<Rit>,
    /// One evaluation at a time: training goes on beside it.
    evaluations: Arc<Semaphore>,
}

impl ControlService {
    /// Speaks to the coordinator by `events`, evaluates the weights on the board, and tells who asks what
    /// `metrics` reads.
    pub fn new(
        events: mpsc::Sender<Event>,
        board: Arc<WeightsBoard>,
        metrics: Follower,
        config: Arc<Config>,
        rit: Arc<Rit>,
    ) -> Self {
        Self { events, board, metrics, config, rit, evaluations: Arc::new(Semaphore::new(1)) }
    }

    async fn ask<T>(&self, question: impl FnOnce(oneshot::Sender<T>) -> Control) -> Result<T, Status> {
        let (answer, answered) = oneshot::channel();
        let over = || Status::unavailable("the run is over");
        self.events.send(Event::Control(question(answer))).await.map_err(|_| over())?;
        answered.await.map_err(|_| over())
    }
}

/// One reader's stream of metrics: lines from disk at its own pace, statuses where there is room.
struct MetricsStream {
    service: ControlService,
    from_env_steps: u64,
    to: mpsc::Sender<Result<v1::MetricsUpdate, Status>>,
}

impl MetricsStream {
    /// Until the run is over, or the reader has gone: then `None`.
    async fn run(mut self, follow: bool, status_every: Option<Duration>) -> Option<()> {
        self.send_lines().await?;
        if !follow {
            return Some(());
        }
        // Without statuses the first tick is never waited for.
        let mut ticks = tokio::time::interval(status_every.unwrap_or(STATUS_EVERY_MIN));
        ticks.set_missed_tick_behavior(MissedTickBehavior::Skip);
        loop {
            tokio::select! {
                more = self.service.metrics.more() => {
                    self.send_lines().await?;
                    if !more {
                        return Some(());
                    }
                }
                _ = ticks.tick(), if status_every.is_some() => {
                    // A run that is ending answers no more; a reader that is behind misses this one.
                    if let Ok(status) = self.service.ask(Control::Status).await {
                        let _ = self.to.try_send(Ok(update(v1::metrics_update::Update::Status(status))));
                    }
                }
                () = self.to.closed() => return None,
            }
        }
    }

    async fn send_lines(&mut self) -> Option<()> {
        loop {
            let mut metrics = self.service.metrics.clone();
            let read = tokio::task::spawn_blocking(move || metrics.read().map(|lines| (metrics, lines)));
            let lines = match read.await {
                Ok(Ok((metrics, lines))) => {
                    self.service.metrics = metrics;
                    lines
                }
                Ok(Err(error)) => return self.fail(&error).await,
                Err(error) => return self.fail(&error).await,
            };
            if lines.is_empty() {
                return Some(());
            }
            for line in lines.iter().filter(|line| line.progress().env_steps >= self.from_env_steps) {
                let line = v1::metrics_update::Update::Line(Line::to_message(line));
                self.to.send(Ok(update(line))).await.ok()?;
            }
        }
    }

    async fn fail(&self, error: &(dyn std::fmt::Display + Sync)) -> Option<()> {
        let _ = self.to.send(Err(Status::internal(format!("metrics.jsonl: {error}")))).await;
        None
    }
}

fn update(update: v1::metrics_update::Update) -> v1::MetricsUpdate {
    v1::MetricsUpdate { update: Some(update) }
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

    type MetricsStream = Pin<Box<dyn Stream<Item = Result<v1::MetricsUpdate, Status>> + Send>>;

    async fn metrics(
        &self,
        request: Request<v1::MetricsRequest>,
    ) -> Result<Response<Self::MetricsStream>, Status> {
        let v1::MetricsRequest { from_env_steps, follow, status_every_ms } = request.into_inner();
        let status_every = (status_every_ms > 0)
            .then(|| Duration::from_millis(status_every_ms.into()).max(STATUS_EVERY_MIN));
        let (to, updates) = mpsc::channel(METRICS_QUEUE);
        let stream = MetricsStream { service: self.clone(), from_env_steps, to };
        tokio::spawn(stream.run(follow, status_every));
        Ok(Response::new(Box::pin(ReceiverStream::new(updates))))
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
