//! The rollout loop: numbered episodes in, finished episodes out. Actors and evaluation share it.

use crate::{Environment, EnvironmentError, EnvironmentFactory, Seated, Task};
use rand::RngExt as _;
use rit_episode::{
    Action, Choice, End, Episode, EpisodeBuilder, Exploration, Observation, Policy, Rng, RunSeed, Stream,
    Turn, decision_order,
};
use std::sync::Arc;

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
    /// Whether an episode that ends at the task's limit counts as cut off there.
    time_limit_bootstraps: bool,
    lost_rounds_max: usize,
    /// Worlds that wait for their next episode, by task.
    idle: Vec<Vec<Seated>>,
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
    builder: EpisodeBuilder,
    /// Steps after which an end is the time limit's, not the task's; `None` where every end is the environment's.
    time_limit: Option<usize>,
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
            time_limit_bootstraps: false,
            lost_rounds_max: LOST_ROUNDS_MAX,
            idle,
        }
    }

    /// Explores with this probability that a random action is the agent's last random one again.
    pub fn with_exploration_persistence(self, exploration_persistence: f32) -> Self {
        Self { exploration_persistence, ..self }
    }

    /// Counts an episode as long as its task's limit as truncated, though the environment may call it terminated: for
    /// methods whose values cannot tell how much time is left.
    pub fn with_time_limit_bootstraps(self, time_limit_bootstraps: bool) -> Self {
        Self { time_limit_bootstraps, ..self }
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
    /// Each time, all worlds are told before the first is waited for: slow ones work side by side.
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
        while !running.is_empty() {
            let mut turns: Vec<Turn<'_>> = running.iter_mut().map(Running::turn).collect();
            policy.act(&mut turns);
            drop(turns);
            let told: Vec<_> =
                running.iter_mut().map(|running| running.world.begin_step(&running.actions)).collect();
            running = running
                .into_iter()
                .zip(told)
                .filter_map(|(mut running, told)| {
                    let stepped = told.and_then(|()| running.step());
                    let ended = match stepped {
                        Ok(ended) => ended,
                        Err(error) => {
                            rolled[running.slot] = Some(Err(self.lost(running.number, running.task, error)));
                            return None;
                        }
                    };
                    watch(running.slot, running.world.environment());
                    let Some((end, won)) = ended else {
                        return Some(running);
                    };
                    self.idle[running.task].push(running.world);
                    rolled[running.slot] = Some(Ok(running.builder.finish(end, won)));
                    None
                })
                .collect();
        }
        rolled.into_iter().flatten().collect()
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
            time_limit: self.time_limit_bootstraps.then(|| world.spec().steps_max),
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
        })
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
        let step = self.world.step(&mut self.environment_rng)?;
        self.world.observe(&mut self.observation);
        self.builder.step(&self.actions, step.reward, step.shaping, &self.observation);
        self.previous_reward = step.reward;
        self.steps += 1;
        let cut_off = self.time_limit.is_some_and(|limit| self.steps >= limit);
        Ok(step.end.map(|end| (if cut_off { End::Truncated } else { end }, step.won)))
    }
}

/// Rounds in a row that may bring no episode at all where nobody says how many; then the environments do not work.
pub const LOST_ROUNDS_MAX: usize = 3;

/// The episodes of jobs none of which was lost.
///
/// # Errors
/// The first that was.
pub fn all_rolled(rolled: Vec<Rolled>) -> Result<Vec<Episode>, LostEpisode> {
    rolled.into_iter().collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{Embedded, EnvironmentOptions, FailureKind, Script, Spec, Split, Step, TaskSet};
    use crate::{Environment, matrix_game::MatrixGame};
    use rit_episode::decision_order::is_permutation;
    use std::sync::atomic::{AtomicUsize, Ordering};

    /// Plays a fixed action by row.
    struct Fixed([Action; 2]);

    impl Policy for Fixed {
        fn begin(&mut self, _: usize, _: usize) {}

        fn act(&mut self, turns: &mut [Turn<'_>]) {
            for turn in turns {
                turn.actions.copy_from_slice(&self.0);
            }
        }
    }

    fn rollout(seed: u64, random_permutation: bool) -> Rollout {
        Rollout::new(
            TaskSet::MatrixGame.tasks(Split::Training),
            Arc::new(Embedded::default()),
            RunSeed(seed),
            random_permutation,
        )
    }

    fn jobs(numbers: std::ops::Range<u64>) -> Vec<Job> {
        numbers.map(|number| Job { number, weights_version: 0, choice: Choice::Greedy, task: None }).collect()
    }

    #[test]
    fn an_episode_is_the_same_whoever_rolls_beside_it() {
        let all = all_rolled(rollout(3, true).roll(&mut Fixed([0, 2]), &jobs(0..20))).unwrap();
        for (number, episode) in all.iter().enumerate() {
            let number = number as u64;
            let alone =
                all_rolled(rollout(3, true).roll(&mut Fixed([0, 2]), &jobs(number..number + 1))).unwrap();
            assert_eq!(alone, std::slice::from_ref(episode));
        }
        let tasks: std::collections::HashSet<_> = all.iter().map(|episode| episode.task).collect();
        assert_eq!(tasks.len(), 4, "20 uniform draws meet all four games");
    }

    #[test]
    fn actions_are_mapped_back_through_the_decision_order() {
        // Game 1 is won by (a¹, a³) of the environment's agents. Rows play (a¹, a³), so it is won exactly
        // when agent 0 decides first; game 4 is won by (a¹, a¹) in either order.
        let jobs: Vec<Job> =
            (0..40).map(|number| Job { task: Some(0), ..jobs(number..number + 1)[0] }).collect();
        let episodes = all_rolled(rollout(5, true).roll(&mut Fixed([0, 2]), &jobs)).unwrap();
        for episode in &episodes {
            assert!(is_permutation(&episode.decision_order));
            assert_eq!(episode.won, episode.decision_order == [0, 1]);
            assert_eq!(episode.rewards[1], if episode.won { 100.0 } else { -12.0 });
            // Row k shows the player one-hot of the agent that sits there, and its own last action.
            for row in 0..2 {
                let features = &episode.entities[(2 + row) * 6..][..6];
                assert_eq!(features[usize::from(episode.decision_order[row])], 1.0);
                assert_eq!(features[3..], [[1.0, 0.0, 0.0], [0.0, 0.0, 1.0]][row]);
            }
        }
        assert!(episodes.iter().any(|episode| episode.won) && episodes.iter().any(|episode| !episode.won));
        let unpermuted = all_rolled(rollout(5, false).roll(&mut Fixed([0, 2]), &jobs)).unwrap();
        assert!(unpermuted.iter().all(|episode| episode.won && episode.end == End::Terminated));
    }

    #[test]
    fn an_end_at_the_time_limit_can_count_as_a_cut() {
        let end = |bootstraps| {
            let mut rollout = rollout(1, true).with_time_limit_bootstraps(bootstraps);
            all_rolled(rollout.roll(&mut Fixed([0, 0]), &jobs(0..1))).unwrap()[0].end
        };
        assert_eq!((end(false), end(true)), (End::Terminated, End::Truncated));
    }

    #[test]
    fn whoever_watches_sees_every_state_of_the_same_episodes() {
        let set = TaskSet::PredatorPrey;
        let new =
            || Rollout::new(set.tasks(Split::Training), Arc::new(Embedded::default()), RunSeed(2), true);
        let jobs = jobs(0..5);
        let mut seen = vec![Vec::new(); jobs.len()];
        let watched = new().roll_watched(&mut Script::Random, &jobs, |job, world| {
            seen[job].push(world.scene().unwrap().bodies);
        });
        let episodes = all_rolled(watched).unwrap();
        assert_eq!(all_rolled(new().roll(&mut Script::Random, &jobs)).as_ref(), Ok(&episodes));
        for (scenes, episode) in seen.iter().zip(&episodes) {
            assert_eq!(scenes.len(), episode.steps() + 1);
            let rows = episode.entities.chunks_exact(set.dims().entity_dim).enumerate();
            for (at, features) in rows {
                let (time, row) = (at / episode.n_entities, at % episode.n_entities);
                let entity = episode.decision_order.get(row).map_or(row, |&agent| usize::from(agent));
                let body = scenes[time][entity];
                assert_eq!([body.x, body.y], features[..2]);
            }
        }
    }

    /// A matrix game in which a step of every so many, over all worlds, fails.
    struct Brittle {
        game: MatrixGame,
        steps: Arc<AtomicUsize>,
        fails_every: usize,
    }

    impl Environment for Brittle {
        fn spec(&self) -> Spec {
            MatrixGame::SPEC
        }

        fn reset(&mut self, rng: &mut Rng) -> Result<(), EnvironmentError> {
            self.game.reset(rng)
        }

        fn observe(&self, observation: &mut Observation) {
            self.game.observe(observation);
        }

        fn step(&mut self, actions: &[Action], rng: &mut Rng) -> Result<Step, EnvironmentError> {
            if self.steps.fetch_add(1, Ordering::Relaxed) % self.fails_every == self.fails_every - 1 {
                return Err(EnvironmentError { kind: FailureKind::Died, detail: "it broke".into() });
            }
            self.game.step(actions, rng)
        }
    }

    /// Makes them, and counts how many it has made.
    struct BrittleWorlds {
        steps: Arc<AtomicUsize>,
        fails_every: usize,
        built: AtomicUsize,
    }

    impl EnvironmentFactory for BrittleWorlds {
        fn build(&self, task: Task) -> Result<Box<dyn Environment>, EnvironmentError> {
            self.built.fetch_add(1, Ordering::Relaxed);
            let Task::MatrixGame { game } = task else { panic!("{task} is no matrix game") };
            let (steps, fails_every) = (Arc::clone(&self.steps), self.fails_every);
            Ok(Box::new(Brittle { game: MatrixGame::new(game), steps, fails_every }))
        }
    }

    fn brittle(fails_every: usize) -> (Rollout, Arc<BrittleWorlds>) {
        let worlds =
            Arc::new(BrittleWorlds { steps: Arc::default(), fails_every, built: AtomicUsize::default() });
        let tasks = TaskSet::MatrixGame.tasks(Split::Training);
        (Rollout::new(tasks, Arc::<BrittleWorlds>::clone(&worlds), RunSeed(3), true), worlds)
    }

    #[test]
    fn a_world_that_fails_costs_its_episode_and_is_built_anew() {
        let (mut rollout, worlds) = brittle(3);
        let jobs: Vec<Job> =
            (0..1).map(|number| Job { task: Some(0), ..jobs(number..number + 1)[0] }).collect();
        // Two steps an episode: the first step of the second episode is the third of all.
        assert!(rollout.roll(&mut Fixed([0, 2]), &jobs)[0].is_ok());
        let lost = rollout.roll(&mut Fixed([0, 2]), &jobs).remove(0).unwrap_err();
        assert_eq!(
            (lost.to_string().as_str(), lost.error.kind),
            ("episode 0 of game-1: it broke", FailureKind::Died)
        );
        assert_eq!(worlds.built.load(Ordering::Relaxed), 1);
        assert!(rollout.roll(&mut Fixed([0, 2]), &jobs)[0].is_ok());
        assert_eq!(worlds.built.load(Ordering::Relaxed), 2);
    }

    #[test]
    fn what_is_lost_is_rolled_again_to_the_same_episode() {
        let jobs = jobs(0..20);
        let expected = all_rolled(rollout(3, true).roll(&mut Fixed([0, 2]), &jobs)).unwrap();
        assert_eq!(brittle(7).0.roll_all(&mut Fixed([0, 2]), &jobs).as_ref(), Ok(&expected));
        let (mut broken, worlds) = brittle(1);
        let lost = broken.roll_all(&mut Fixed([0, 2]), &jobs).unwrap_err();
        assert_eq!((lost.number, lost.error.detail.as_str()), (19, "it broke"));
        assert_eq!(worlds.built.load(Ordering::Relaxed), 20 * LOST_ROUNDS_MAX);
        let (broken, worlds) = brittle(1);
        assert!(broken.with_lost_rounds_max(1).roll_all(&mut Fixed([0, 2]), &jobs).is_err());
        assert_eq!(worlds.built.load(Ordering::Relaxed), 20);
    }

    #[test]
    fn options_reach_the_environments() {
        for (view_radius, sees_others) in [(None, true), (Some(0.0), false)] {
            let tasks = TaskSet::CooperativeNavigation.tasks(Split::Training);
            let options = EnvironmentOptions { view_radius, ..EnvironmentOptions::default() };
            let rolled = Rollout::new(tasks, Arc::new(Embedded(options)), RunSeed(1), true)
                .roll(&mut Fixed([0, 0]), &[Job { task: Some(0), ..jobs(0..1)[0] }]);
            let episodes = all_rolled(rolled).unwrap();
            let rows = episodes[0].observable.chunks_exact(4).enumerate();
            for (row, seen) in rows {
                let itself_only = [[1, 0, 0, 0], [0, 1, 0, 0]][row % 2];
                assert_eq!(seen, if sees_others { [1; 4] } else { itself_only });
            }
            assert_eq!(episodes[0].steps(), 25);
        }
    }
}
