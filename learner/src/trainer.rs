//! Training: batches of episodes in, weights out (paper, algorithm 1). One thread, which owns replay and
//! weights; nothing it does depends on time.

mod ending;
mod evaluating;
mod messages;

pub use evaluating::evaluation_seed;
pub use messages::{Checkpointed, News, Standing, TrainError, Work};

use crate::{
    checkpoint::{Loaded, Manifest, Origin, SnapshotMark, TrainingState},
    cpu_time::CpuTime,
    evaluation::Evaluator,
    ledger::Terms,
    metrics::{Follower, MetricsFile, Recent},
    metrics_repair::End,
    replay::Replay,
    tensorboard::{EventFile, Position},
    weights::{Snapshot, WeightsBoard},
    write_queue::WriteQueue,
    writer::Written,
};
use rit_algo::{
    Learner, Model, Regime,
    learner::{Draw, Measure, NamedState, StateError},
};
use rit_config::{Config, RunDir, Until};
use rit_env::Split;
use rit_episode::{Episode, Stream};
use rit_policy::weights_file;
use rit_record::{
    Best, Build, Ended, Header, Line, Measured, Progress, Run, Summary, TaskResult, TrainingPoint,
};
use std::{
    collections::VecDeque,
    fs,
    sync::{Arc, mpsc},
};
use tokio::sync::oneshot;

/// The trainer.
pub struct Trainer {
    config: Config,
    run_dir: RunDir,
    model: Arc<Model>,
    learner: Box<dyn Learner>,
    /// None where each batch is learned from once.
    replay: Option<Replay>,
    board: Arc<WeightsBoard>,
    evaluator: Evaluator,
    metrics: MetricsFile,
    tensorboard: EventFile,
    recent: Recent,
    standing: Standing,
    /// What the next batches are rolled with, in order.
    terms: VecDeque<Terms>,
    /// Collected episodes when the target network was last copied.
    target_copied_at: u64,
    /// Environment steps before the last batch.
    env_steps_before: u64,
    news: Box<dyn FnMut(News) + Send>,
    writer: WriteQueue,
    /// Warnings of how this learner began and ended.
    warnings: Vec<String>,
    /// What checkpoints say of where they come from.
    origin: Origin,
    made: Made,
    /// Seconds of processor time that learners before this one and their actors took.
    cpu_before_s: f64,
    /// The newest scheduled evaluation of this learner, episode by episode.
    evaluated: Option<(Progress, Vec<TaskResult>)>,
    /// The best policy so far with its parameters, where it is kept.
    best: Option<(Best, Vec<f32>)>,
}

/// A method's networks, and the learner that trains them.
pub struct Algorithm {
    /// The networks.
    pub model: Arc<Model>,
    /// The learner, with the weights that the run begins with.
    pub learner: Box<dyn Learner>,
}

/// What a run is made with, for its record.
#[derive(Clone, Debug, Default)]
pub struct Made {
    /// This program.
    pub build: Build,
    /// What the run's processes take.
    pub cpu: Arc<CpuTime>,
}

/// Where a run begins: what the rest of the learner needs to know of it.
#[derive(Clone, Debug)]
pub struct Beginning {
    /// Batches done.
    pub batches: u64,
    /// What the next ones are rolled with, in order.
    pub terms: Vec<Terms>,
    /// How training stands.
    pub standing: Standing,
    /// What its updates report.
    pub measures: &'static [Measure],
    /// Warnings.
    pub warnings: Vec<String>,
}

impl Trainer {
    /// A trainer at the beginning of a run or where a checkpoint was written, and the board it publishes its
    /// weights on. `news` must not wait.
    ///
    /// # Errors
    /// When the metrics files cannot be had, or the checkpoint is not this learner's.
    pub fn new(
        config: Config,
        run_dir: RunDir,
        Algorithm { model, learner }: Algorithm,
        loaded: Option<Loaded>,
        news: Box<dyn FnMut(News) + Send>,
        writer: WriteQueue,
        made: Made,
    ) -> Result<(Self, Arc<WeightsBoard>), TrainError> {
        let lag = config.algorithm.policy_lag;
        let first = Snapshot::new(0, 0, acting_params(&*learner));
        let first_terms = Terms { weights_version: 0, epsilon: config.epsilon(0) };
        let task_set = config.environment.task_set;
        let tasks = config.tasks(Split::Training).iter().map(ToString::to_string).collect();
        let mut warnings = loaded.as_ref().map(|loaded| loaded.warnings.clone()).unwrap_or_default();
        let manifest = loaded.as_ref().map(|loaded| &loaded.state.manifest);
        let run = Run::begins(&config, made.build.clone(), learner.params().len(), learner.measures())?;
        let header = Header::new(&run_dir, run);
        // Of the checkpoint's own the log tells already.
        let logged = warnings.len();
        let (metrics, tensorboard) = files(&run_dir, &header, manifest, &mut warnings)?;
        warnings.iter().skip(logged).for_each(|warning| tracing::warn!("{warning}"));
        let mut trainer = Self {
            replay: (learner.regime() == Regime::Replay).then(|| Replay::new(config.algorithm.buffer_size)),
            board: Arc::new(WeightsBoard::new(first, lag)),
            evaluator: Evaluator::new(&config),
            metrics,
            tensorboard,
            recent: Recent::new(tasks, task_set.has_wins()),
            standing: Standing::default(),
            terms: vec![first_terms; lag + 1].into(),
            target_copied_at: 0,
            env_steps_before: 0,
            news,
            writer,
            warnings,
            origin: Origin::of(&run_dir, &config)?,
            cpu_before_s: manifest.map_or(0.0, |manifest| manifest.cpu_s),
            made,
            evaluated: None,
            best: None,
            model,
            learner,
            run_dir,
            config,
        };
        if let Some(loaded) = loaded {
            trainer.go_on_from(loaded)?;
        }
        let board = Arc::clone(&trainer.board);
        Ok((trainer, board))
    }

    /// A reader of the metrics file.
    pub fn metrics_follower(&self) -> Follower {
        self.metrics.follower()
    }

    /// Where the run begins.
    pub fn beginning(&self) -> Beginning {
        Beginning {
            batches: self.standing.progress.episodes / self.config.algorithm.n_rollout_threads as u64,
            terms: self.terms.iter().copied().collect(),
            standing: self.standing.clone(),
            measures: self.learner.measures(),
            warnings: self.warnings.clone(),
        }
    }

    fn go_on_from(&mut self, loaded: Loaded) -> Result<(), StateError> {
        let TrainingState { params, best, learner, snapshots, manifest } = loaded.state;
        let kept_by = self.config.checkpoints.keep_best.name();
        // By another measure none of the evaluations before says which was the best.
        self.best = manifest.best.filter(|best| best.measure == kept_by).zip(best);
        self.learner.restore(&params, &learner)?;
        self.target_copied_at = manifest.target_copied_at;
        self.env_steps_before = manifest.env_steps_before;
        self.terms = manifest.terms.into();
        let mut snapshots = snapshots.into_iter();
        if let Some(oldest) = snapshots.next() {
            self.board = Arc::new(WeightsBoard::new(oldest, self.config.algorithm.policy_lag));
        }
        snapshots.for_each(|snapshot| self.board.publish(snapshot));
        self.recent.restore(manifest.recent, manifest.exploring);
        if let Some(replay) = &mut self.replay {
            loaded.replay.into_iter().for_each(|episode| replay.insert(Arc::new(episode)));
        }
        let named = |(task, result): (String, TaskResult)| TaskResult { task, ..result };
        self.standing = Standing {
            progress: manifest.progress,
            measured: Measured::default(),
            recent: self.recent.results(),
            evaluation: manifest
                .evaluation
                .map(|(at, results)| (at, results.into_iter().map(named).collect())),
            replay_episodes: self.replay.as_ref().map_or(0, Replay::len),
        };
        Ok(())
    }

    /// Works until the run is over or the threads around it have failed, then writes checkpoint and summary.
    ///
    /// # Errors
    /// When a file cannot be written or the weights diverge.
    pub fn run(mut self, work: &mpsc::Receiver<Work>) -> Result<Summary, TrainError> {
        let finished = self.train_until_over(work).and_then(|ended| {
            (self.news)(News::Ending);
            self.finish(ended, work)
        });
        if let Err(error) = &finished {
            (self.news)(News::Ending);
            let diverged = matches!(error, TrainError::NotFinite { .. });
            let reason = Some(error.to_string());
            let summary = Summary { reason, diverged, ..self.summary(Ended::Failed) };
            // A disk that refuses has been complained of.
            let _ = summary.write(&self.run_dir);
        }
        finished
    }

    /// Works until the run is over; returns how it ended.
    fn train_until_over(&mut self, work: &mpsc::Receiver<Work>) -> Result<Ended, TrainError> {
        if self.standing.evaluation.is_none() {
            self.evaluate()?;
            if self.config.evaluation.testing_every_env_steps > 0 {
                self.evaluate_testing()?;
            }
        }
        loop {
            if let Some(ended) = self.over() {
                return Ok(ended);
            }
            // The threads around this one have failed.
            let Ok(work) = work.recv() else { return Ok(Ended::Failed) };
            match work {
                Work::Batch(episodes) => {
                    self.train(episodes)?;
                    // The terms of the batch that `policy_lag` leaves to be opened next.
                    let terms = Terms {
                        weights_version: self.standing.progress.updates,
                        epsilon: self.config.epsilon(self.standing.progress.env_steps),
                    };
                    self.terms.pop_front();
                    self.terms.push_back(terms);
                    (self.news)(News::Trained(terms, self.standing.clone()));
                    if self.is_due(self.config.checkpoints.every_env_steps) && self.over().is_none() {
                        self.checkpoint(None);
                    }
                }
                Work::Checkpoint(answer) => {
                    let (done, written) = oneshot::channel();
                    let weights_digest = self.checkpoint(Some(done));
                    let progress = self.standing.progress;
                    // The caller may have gone.
                    let _ = answer.send(Checkpointed { progress, weights_digest, written });
                }
                Work::Set(config) => {
                    let other_result = self.config.algorithm != config.algorithm
                        || self.config.evaluation != config.evaluation;
                    self.config = Config::clone(&config);
                    self.evaluator = Evaluator::new(&config);
                    self.origin = Origin::of(&self.run_dir, &config)?;
                    if other_result {
                        // What was trained so far is not trained again under other settings.
                        self.checkpoint(None);
                    }
                }
                Work::Stop(ended) => return Ok(ended),
            }
        }
    }

    /// One batch: into replay, where there is one, one update, and what is due to be measured.
    fn train(&mut self, episodes: Vec<Episode>) -> Result<(), TrainError> {
        let collected = self.collect(episodes);
        self.update(&collected)?;
        self.standing.replay_episodes = self.replay.as_ref().map_or(0, Replay::len);
        self.standing.recent = self.recent.results();
        self.measure_what_is_due()
    }

    /// Counts a batch, and adds it to replay, where there is one.
    fn collect(&mut self, episodes: Vec<Episode>) -> Vec<Arc<Episode>> {
        let progress = &mut self.standing.progress;
        self.env_steps_before = progress.env_steps;
        let mut collected = Vec::with_capacity(episodes.len());
        for episode in episodes {
            progress.env_steps += episode.steps() as u64;
            progress.episodes += 1;
            self.recent.push(&episode, progress.updates);
            let episode = Arc::new(episode);
            if let Some(replay) = &mut self.replay {
                self.writer.episode(Arc::clone(&episode));
                replay.insert(Arc::clone(&episode));
            }
            collected.push(episode);
        }
        collected
    }

    /// Makes an update with the batch, or with one drawn from replay once that holds enough; publishes the weights.
    fn update(&mut self, collected: &[Arc<Episode>]) -> Result<(), TrainError> {
        let algorithm = &self.config.algorithm;
        let progress = &mut self.standing.progress;
        let draw = Draw { seed: self.config.seed, update: progress.updates };
        let batch = match &self.replay {
            Some(replay) if replay.len() < algorithm.batch_size => None,
            Some(replay) => Some(replay.sample(algorithm.batch_size, &mut draw.stream(Stream::Replay))),
            None => Some(collected.iter().map(|episode| &**episode).collect()),
        };
        if let Some(batch) = batch {
            let learned = self.learner.learn(&batch, draw);
            progress.updates += 1;
            let values = learned.map_err(|error| TrainError::NotFinite {
                update: progress.updates,
                error,
                lr: algorithm.lr / 10.0,
            })?;
            self.standing.measured = Measured::new(self.learner.measures(), &values);
            if progress.episodes - self.target_copied_at >= algorithm.target_update_interval {
                self.learner.update_target();
                self.target_copied_at = progress.episodes;
            }
            let acting = acting_params(&*self.learner);
            self.board.publish(Snapshot::new(progress.updates, progress.env_steps, acting));
        }
        Ok(())
    }

    fn measure_what_is_due(&mut self) -> Result<(), TrainError> {
        if self.is_due(self.config.learner.metrics_every_env_steps) {
            let standing = &self.standing;
            let tasks = standing.recent.iter().map(|result| (result.task.clone(), result.clone()));
            let point = TrainingPoint {
                progress: standing.progress,
                wall_s: self.metrics.wall_s(),
                epsilon: self.config.epsilon(standing.progress.env_steps).into(),
                measured: standing.measured.clone(),
                tasks: tasks.collect(),
            };
            self.measured(&Line::Training(point))?;
        }
        if self.is_due(self.config.evaluation.every_env_steps) {
            self.evaluate()?;
        }
        let testing_every = self.config.evaluation.testing_every_env_steps;
        if testing_every > 0 && self.is_due(testing_every) {
            self.evaluate_testing()?;
        }
        Ok(())
    }

    fn measured(&mut self, line: &Line) -> Result<(), TrainError> {
        self.metrics.write(line).map_err(|error| TrainError::Io { path: self.run_dir.metrics(), error })?;
        self.tensorboard.write(line);
        Ok(())
    }

    /// Seconds of processor time that the run has taken.
    fn cpu_s(&self) -> f64 {
        self.cpu_before_s + self.made.cpu.seconds()
    }

    /// How the run ends, if all steps are done or an evaluation made just now says that it is enough. What a checkpoint
    /// holds counts: a run that was over when it was saved is over when it is loaded.
    fn over(&self) -> Option<Ended> {
        let Standing { progress, evaluation, .. } = &self.standing;
        let reached = |(at, results): &(Progress, Vec<TaskResult>)| at == progress && self.reached(results);
        if evaluation.as_ref().is_some_and(reached) {
            return Some(Ended::Until);
        }
        (progress.env_steps >= self.config.training.t_max).then_some(Ended::Finished)
    }

    fn reached(&self, results: &[TaskResult]) -> bool {
        match self.config.training.until {
            Until::Never => false,
            Until::WinRate(goal) => results.iter().all(|result| result.win_rate >= Some(goal)),
            Until::MeanReturn(goal) => results.iter().all(|result| result.mean_return >= goal),
        }
    }

    /// Whether the last batch passed a multiple of so many environment steps.
    fn is_due(&self, every: u64) -> bool {
        self.standing.progress.env_steps / every > self.env_steps_before / every
    }

    /// Hands a copy of everything to the writer. Returns the weights' digest.
    fn checkpoint(&mut self, done: Option<oneshot::Sender<Written>>) -> String {
        // What the disk still refuses, it will refuse the checkpoint too, which then says so.
        let _ = self.metrics.flush().and_then(|()| self.tensorboard.flush());
        let weights_digest = weights_file::digest(self.learner.params());
        let kept = self.board.all_kept();
        let mark = |snapshot: &Arc<Snapshot>| SnapshotMark {
            version: snapshot.version,
            env_steps: snapshot.env_steps,
        };
        let evaluation = self.standing.evaluation.as_ref().map(|(at, results)| {
            (*at, results.iter().map(|result| (result.task.clone(), result.clone())).collect())
        });
        let state = TrainingState {
            params: self.learner.params().to_vec(),
            best: self.best.as_ref().map(|(_, params)| params.clone()),
            learner: self.learner.state().into_iter().map(NamedState::into_owned).collect(),
            manifest: Manifest {
                origin: self.origin.clone(),
                progress: self.standing.progress,
                env_steps_before: self.env_steps_before,
                target_copied_at: self.target_copied_at,
                terms: self.terms.iter().copied().collect(),
                snapshots: kept.iter().map(mark).collect(),
                recent: self.recent.windows(),
                exploring: self.recent.exploring().to_vec(),
                metrics_len: self.metrics.len(),
                tensorboard: self.tensorboard.position(),
                wall_s: self.metrics.wall_s(),
                cpu_s: self.cpu_s(),
                evaluation,
                best: self.best.as_ref().map(|(best, _)| best.clone()),
                weights_digest: weights_digest.clone(),
            },
            snapshots: kept.iter().map(|snapshot| Snapshot::clone(snapshot)).collect(),
        };
        // A writer that has gone drops `done`, which tells those that wait.
        self.writer.checkpoint(Box::new(state), done);
        weights_digest
    }
}

/// The weights that actors need.
fn acting_params(learner: &dyn Learner) -> &[f32] {
    &learner.params()[learner.acting()]
}

/// The files that show how training goes: begun, or continued from a checkpoint. What was repaired is said.
fn files(
    run_dir: &RunDir,
    header: &Header,
    manifest: Option<&Manifest>,
    warnings: &mut Vec<String>,
) -> Result<(MetricsFile, EventFile), TrainError> {
    let wall_s = manifest.map_or(0.0, |manifest| manifest.wall_s);
    let end = manifest
        .map(|Manifest { progress, metrics_len: len, .. }| End { env_steps: progress.env_steps, len: *len });
    let path = run_dir.metrics();
    if manifest.is_none() && fs::metadata(&path).is_ok_and(|metadata| metadata.len() > 0) {
        warnings.push(
            "no checkpoint was written yet: training begins again at step 0, and metrics.jsonl with it"
                .into(),
        );
    }
    let metrics = MetricsFile::open(&path, header, end, wall_s);
    let (metrics, warning) = metrics.map_err(|error| TrainError::Metrics { path, error })?;
    warnings.extend(warning);
    let (position, from) = manifest.map_or((Position::default(), 0), |manifest| {
        (manifest.tensorboard.clone(), manifest.progress.env_steps + 1)
    });
    let path = run_dir.tensorboard();
    let tensorboard = EventFile::create(&path, run_dir, &position, from);
    let (tensorboard, repaired) = tensorboard.map_err(|error| TrainError::Io { path, error })?;
    warnings.extend(repaired);
    Ok((metrics, tensorboard))
}

#[cfg(test)]
mod tests;
