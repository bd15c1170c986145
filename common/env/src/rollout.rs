//! The rollout loop: numbered episodes in, finished episodes out. Actors and evaluation share it.

use crate::{Environment, EnvironmentError, EnvironmentFactory, Seated, Task};
use rand::RngExt as _;
use rit_episode::{
    Action, Choice, End, Episode, EpisodeBuilder, Exploration, Observation, Policy, Rng, RunSeed, Stream,
    Turn, decision_order,
};
use serde::{Deserialize, Serialize};
use std::{mem, sync::Arc};

/// An episode to be rolled.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Job {
    /// Its number: the index of all its random streams.
    pub number: u64,
    /// The weights the policy acts with, recorded in the episode.
    pub weights_version: u64,
    /// How its actions come about.
    pub choice: Choice,
    /// Index of the task; drawn uniformly from the episode's own stream where `None`.
    pub task: Option<usize>,
}

/// Rolls episodes of a list of tasks, several at once. What an episode holds depends on the seed, its job
/// and the policy alone, not on the jobs beside it.
pub struct Rollout {
    tasks: Vec<Task>,
    factory: Arc<dyn EnvironmentFactory>,
    seed: RunSeed,
    random_permutation: bool,
    exploration_persistence: f32,
    time_limit: TimeLimit,
    lost_rounds_max: usize,
    /// Worlds that wait for their next episode, by task.
    idle: Vec<Vec<Seated>>,
}

/// How an episode ends that reaches its task's time limit.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Hash, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum TimeLimit {
    /// As its environment says.
    #[default]
    Environment,
    /// Cut off where time alone has ended it: values go on beyond it. What the task itself has ended on that step, such as
    /// a battle that is won or lost, is over. For methods whose values cannot tell how much time is left.
    Truncated,
    /// Over: nothing is earned beyond it.
    Terminated,
}

/// An episode that ended early because its environment could not go on.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[error("episode {number} of {task}: {error}")]
pub struct LostEpisode {
    /// Its number.
    pub number: u64,
    /// Its task.
    pub task: String,
    /// Why.
    #[source]
    pub error: EnvironmentError,
}

/// What became of a job.
pub type Rolled = Result<Episode, LostEpisode>;

/// A job whose environment was told to begin.
struct Beginning {
    slot: usize,
    job: Job,
    task: usize,
    world: Seated,
    order: Vec<u8>,
    environment_rng: Rng,
}

/// A running episode.
struct Running {
    slot: usize,
    number: u64,
    task: usize,
    world: Seated,
    environment_rng: Rng,
    exploration: Exploration,
    observation: Observation,
    previous_reward: f32,
    actions: Vec<Action>,
    /// Whether its environment could be told the actions.
    told: Result<(), EnvironmentError>,
    builder: EpisodeBuilder,
    time_limit: TimeLimit,
    /// See [`Environment::is_over_at_limit`].
    is_over_at_limit: bool,
    steps_max: usize,
    steps: usize,
}

impl Rollout {
    /// Rolls episodes of these tasks in worlds of this factory, with streams of this seed; with `random_permutation`
    /// each episode's decision order is a fresh uniform permutation.
    ///
    /// # Panics
    /// Without tasks.
    pub fn new(
        tasks: Vec<Task>,
        factory: Arc<dyn EnvironmentFactory>,
        seed: RunSeed,
        random_permutation: bool,
    ) -> Self {
        assert!(!tasks.is_empty(), "a rollout needs a task");
        let idle = tasks.iter().map(|_| Vec::new()).collect();
        Self {
            tasks,
            factory,
            seed,
            random_permutation,
            exploration_persistence: 0.0,
            time_limit: TimeLimit::Environment,
            lost_rounds_max: LOST_ROUNDS_MAX,
            idle,
        }
    }

    /// Explores with this probability that a random action is the agent's last random one again.
    pub fn with_exploration_persistence(self, exploration_persistence: f32) -> Self {
        Self { exploration_persistence, ..self }
    }

    /// Ends episodes that reach their task's time limit so.
    pub fn with_time_limit(self, time_limit: TimeLimit) -> Self {
        Self { time_limit, ..self }
    }

    /// Gives up after so many rounds in a row that brought no episode at all; see [`Self::roll_all`].
    pub fn with_lost_rounds_max(self, lost_rounds_max: usize) -> Self {
        Self { lost_rounds_max, ..self }
    }

    /// Rolls all jobs side by side to their ends and returns what became of them, in the jobs' order. A world whose
    /// episode is lost is not used again.
    pub fn roll(&mut self, policy: &mut dyn Policy, jobs: &[Job]) -> Vec<Rolled> {
        self.roll_watched(policy, jobs, |_, _| {})
    }

    /// As [`Self::roll`], and shows each job's world to `watch`, under the job's index: when its episode has
    /// begun, and after each step. What was done and earned there is in the [`Episode`].
    ///
    /// Each time, all worlds are told before the first is waited for: slow ones work side by side. Those that step in
    /// processes of their own are told in two halves ([`EnvironmentFactory::steps_elsewhere`]).
    pub fn roll_watched(
        &mut self,
        policy: &mut dyn Policy,
        jobs: &[Job],
        mut watch: impl FnMut(usize, &dyn Environment),
    ) -> Vec<Rolled> {
        let mut rolled: Vec<Option<Rolled>> = jobs.iter().map(|_| None).collect();
        let beginning: Vec<Result<Beginning, (usize, LostEpisode)>> =
            jobs.iter().enumerate().map(|(slot, job)| self.tell_to_begin(slot, job)).collect();
        let mut running = Vec::with_capacity(jobs.len());
        for beginning in beginning {
            match beginning.and_then(|beginning| self.begin(policy, beginning)) {
                Ok(begun) => running.push(begun),
                Err((slot, lost)) => rolled[slot] = Some(Err(lost)),
            }
        }
        running.iter().for_each(|running| watch(running.slot, running.world.environment()));
        let mut groups = self.groups(running);
        groups.iter_mut().for_each(|group| act(policy, group));
        while groups.iter().any(|group| !group.is_empty()) {
            for group in &mut groups {
                self.step(group, &mut rolled, &mut watch);
                act(policy, group);
            }
        }
        rolled.into_iter().flatten().collect()
    }

    /// Splits the episodes into groups that act together: all, or two halves if worlds step in other processes. Neighbours
    /// share a process, so taking every other one gives each process worlds of both halves.
    fn groups(&self, running: Vec<Running>) -> Vec<Vec<Running>> {
        if !self.factory.steps_elsewhere() {
            return vec![running];
        }
        let mut halves = vec![Vec::new(), Vec::new()];
        running.into_iter().enumerate().for_each(|(at, running)| halves[at % 2].push(running));
        halves
    }

    /// Waits for what a group's joint actions lead to; keeps those whose episodes go on.
    fn step(
        &mut self,
        group: &mut Vec<Running>,
        rolled: &mut [Option<Rolled>],
        watch: &mut impl FnMut(usize, &dyn Environment),
    ) {
        for mut running in mem::take(group) {
            let ended = match running.step() {
                Ok(ended) => ended,
                Err(error) => {
                    rolled[running.slot] = Some(Err(self.lost(running.number, running.task, error)));
                    continue;
                }
            };
            watch(running.slot, running.world.environment());
            let Some((end, won)) = ended else {
                group.push(running);
                continue;
            };
            self.idle[running.task].push(running.world);
            rolled[running.slot] = Some(Ok(running.builder.finish(end, won)));
        }
    }

    /// As [`Self::roll`]; jobs whose episodes are lost are rolled again, under their numbers.
    ///
    /// # Errors
    /// The last that was lost when too many rounds in a row have brought none: [`LOST_ROUNDS_MAX`], or as many as
    /// [`Self::with_lost_rounds_max`] says.
    pub fn roll_all(&mut self, policy: &mut dyn Policy, jobs: &[Job]) -> Result<Vec<Episode>, LostEpisode> {
        let mut episodes: Vec<Option<Episode>> = jobs.iter().map(|_| None).collect();
        let mut left: Vec<usize> = (0..jobs.len()).collect();
        let mut lost_rounds = 0;
        while !left.is_empty() {
            let round: Vec<Job> = left.iter().map(|&at| jobs[at]).collect();
            let (mut lost_ones, mut last) = (Vec::new(), None);
            for (&at, rolled) in left.iter().zip(self.roll(policy, &round)) {
                match rolled {
                    Ok(episode) => episodes[at] = Some(episode),
                    Err(lost) => {
                        lost_ones.push(at);
                        last = Some(lost);
                    }
                }
            }
            lost_rounds = if lost_ones.len() < left.len() { 0 } else { lost_rounds + 1 };
            if let Some(lost) = last.filter(|_| lost_rounds >= self.lost_rounds_max) {
                return Err(lost);
            }
            left = lost_ones;
        }
        Ok(episodes.into_iter().flatten().collect())
    }

    fn lost(&self, number: u64, task: usize, error: EnvironmentError) -> LostEpisode {
        LostEpisode { number, task: self.tasks[task].to_string(), error }
    }

    fn tell_to_begin(&mut self, slot: usize, job: &Job) -> Result<Beginning, (usize, LostEpisode)> {
        let stream = |name| self.seed.stream(name, job.number);
        let task = job.task.unwrap_or_else(|| stream(Stream::Task).random_range(0..self.tasks.len()));
        let mut environment_rng = stream(Stream::Environment);
        let mut order_rng = stream(Stream::DecisionOrder);
        let world = match self.idle[task].pop() {
            Some(world) => Ok(world),
            None => self.factory.build(self.tasks[task]).map(Seated::new),
        };
        let mut world = world.map_err(|error| (slot, self.lost(job.number, task, error)))?;
        let n_agents = world.spec().n_agents;
        let order = if self.random_permutation {
            decision_order::draw(n_agents, &mut order_rng)
        } else {
            decision_order::identity(n_agents)
        };
        match world.begin_reset(order.clone(), &mut environment_rng) {
            Ok(()) => Ok(Beginning { slot, job: *job, task, world, order, environment_rng }),
            Err(error) => Err((slot, self.lost(job.number, task, error))),
        }
    }

    fn begin(&self, policy: &mut dyn Policy, beginning: Beginning) -> Result<Running, (usize, LostEpisode)> {
        let Beginning { slot, job, task, mut world, order, mut environment_rng } = beginning;
        if let Err(error) = world.reset(&mut environment_rng) {
            return Err((slot, self.lost(job.number, task, error)));
        }
        let n_agents = world.spec().n_agents;
        let mut observation = Observation::default();
        world.observe(&mut observation);
        policy.begin(slot, n_agents);
        Ok(Running {
            slot,
            number: job.number,
            task,
            time_limit: self.time_limit,
            is_over_at_limit: world.environment().is_over_at_limit(),
            steps_max: world.spec().steps_max,
            steps: 0,
            world,
            environment_rng,
            exploration: Exploration::new(
                job.choice,
                self.exploration_persistence,
                n_agents,
                self.seed.stream(Stream::Exploration, job.number),
            ),
            builder: EpisodeBuilder::new(job.number, job.weights_version, task, order, &observation),
            observation,
            previous_reward: 0.0,
            actions: vec![0; n_agents],
            told: Ok(()),
        })
    }
}

/// Chooses a group's joint actions, and tells them to its worlds.
fn act(policy: &mut dyn Policy, group: &mut [Running]) {
    if group.is_empty() {
        return;
    }
    let mut turns: Vec<Turn<'_>> = group.iter_mut().map(Running::turn).collect();
    policy.act(&mut turns);
    drop(turns);
    for running in group {
        running.told = running.world.begin_step(&running.actions);
    }
}

impl Running {
    fn turn(&mut self) -> Turn<'_> {
        Turn {
            slot: self.slot,
            observation: &self.observation,
            previous_reward: self.previous_reward,
            exploration: &mut self.exploration,
            actions: &mut self.actions,
        }
    }

    /// Waits for what the joint action leads to; returns how the episode ended once it has.
    fn step(&mut self) -> Result<Option<(End, bool)>, EnvironmentError> {
        mem::replace(&mut self.told, Ok(()))?;
        let step = self.world.step(&mut self.environment_rng)?;
        self.world.observe(&mut self.observation);
        self.builder.step(&self.actions, step.reward, step.shaping, &self.observation);
        self.previous_reward = step.reward;
        self.steps += 1;
        let is_at_limit = self.steps >= self.steps_max;
        let end_of = |end| match self.time_limit {
            // Of what is over on its last step, only a world that ends for want of time can be cut off there.
            TimeLimit::Truncated if is_at_limit && self.is_over_at_limit && !step.won => End::Truncated,
            TimeLimit::Terminated if is_at_limit => End::Terminated,
            _ => end,
        };
        Ok(step.end.map(|end| (end_of(end), step.won)))
    }
}

/// Default of [`Rollout::with_lost_rounds_max`]: after so many rounds in a row that lost every episode, the environments
/// count as broken.
pub const LOST_ROUNDS_MAX: usize = 3;

/// The episodes of jobs none of which was lost.
///
/// # Errors
/// The first that was.
pub fn all_rolled(rolled: Vec<Rolled>) -> Result<Vec<Episode>, LostEpisode> {
    rolled.into_iter().collect()
}

#[cfg(test)]
mod tests;
