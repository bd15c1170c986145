//! `rit.v1.Control`: what people and scripts ask of a running learner.

use crate::{
    coordinator::Control,
    messages,
    metrics::Follower,
    run_handle::{AskError, RunHandle},
};
use rit_proto::v1::{self, control_server};
use rit_record::{Ended, Line};
use std::{pin::Pin, time::Duration};
use tokio::{sync::mpsc, time::MissedTickBehavior};
use tokio_stream::{Stream, wrappers::ReceiverStream};
use tonic::{Request, Response, Status};

/// Updates that may wait for one reader of metrics.
const METRICS_QUEUE: usize = 16;

/// The shortest time from one status in a stream of metrics to the next.
const STATUS_EVERY_MIN: Duration = Duration::from_millis(50);

/// `rit.v1.Control`.
#[derive(Clone)]
pub struct ControlService {
    /// The run it speaks for.
    pub run: RunHandle,
    /// What has been measured.
    pub metrics: Follower,
}

/// One reader's stream of metrics: lines from disk at its own pace, statuses where there is room.
struct MetricsReader {
    service: ControlService,
    from_env_steps: u64,
    to: mpsc::Sender<Result<v1::MetricsUpdate, Status>>,
}

impl MetricsReader {
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
                    // A run that is ending answers no more; a reader that is too slow misses this one.
                    if let Ok(status) = self.service.run.ask(Control::Status).await {
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
            let is_wanted = |line: &&Line| {
                line.progress().is_none_or(|progress| progress.env_steps >= self.from_env_steps)
            };
            for line in lines.iter().filter(is_wanted).filter_map(messages::line) {
                self.to.send(Ok(update(v1::metrics_update::Update::Line(line)))).await.ok()?;
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
        Ok(Response::new(self.run.ask(Control::Status).await?))
    }

    async fn pause(&self, _: Request<v1::PauseRequest>) -> Result<Response<v1::RunStatus>, Status> {
        Ok(Response::new(self.run.pause().await?))
    }

    async fn resume(&self, _: Request<v1::ResumeRequest>) -> Result<Response<v1::RunStatus>, Status> {
        Ok(Response::new(self.run.resume().await?))
    }

    async fn stop(&self, request: Request<v1::StopRequest>) -> Result<Response<v1::RunStatus>, Status> {
        let v1::StopRequest { drain, interrupted } = request.into_inner();
        let ended = if interrupted { Ended::Interrupted } else { Ended::Stopped };
        Ok(Response::new(self.run.ask(|answer| Control::Stop { drain, ended, answer }).await?))
    }

    async fn set(&self, request: Request<v1::SetRequest>) -> Result<Response<v1::RunStatus>, Status> {
        Ok(Response::new(self.run.set(request.into_inner()).await?))
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
        let reader = MetricsReader { service: self.clone(), from_env_steps, to };
        tokio::spawn(reader.run(follow, status_every));
        Ok(Response::new(Box::pin(ReceiverStream::new(updates))))
    }

    async fn checkpoint(
        &self,
        _: Request<v1::CheckpointRequest>,
    ) -> Result<Response<v1::CheckpointResponse>, Status> {
        Ok(Response::new(self.run.checkpoint().await?))
    }

    async fn evaluate(
        &self,
        request: Request<v1::EvaluateRequest>,
    ) -> Result<Response<v1::Evaluation>, Status> {
        Ok(Response::new(self.run.evaluate(request.into_inner()).await?))
    }
}

impl From<AskError> for Status {
    fn from(error: AskError) -> Self {
        let message = error.to_string();
        match error {
            AskError::Over => Self::unavailable(message),
            AskError::Busy => Self::resource_exhausted(message),
            AskError::Task(_)
            | AskError::Tasks(_)
            | AskError::Episodes(_)
            | AskError::Setting(_)
            | AskError::Log(_) => Self::invalid_argument(message),
            AskError::Checkpoint(_) | AskError::Panicked(_) | AskError::Lost(_) => Self::internal(message),
        }
    }
}
