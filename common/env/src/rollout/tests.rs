use super::*;
use crate::{Embedded, EnvironmentOptions, FailureKind, Physics, Script, Spec, Split, Step, TaskSet};
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
fn an_episode_is_the_same_with_any_episodes_beside_it() {
    let all = all_rolled(rollout(3, true).roll(&mut Fixed([0, 2]), &jobs(0..20))).unwrap();
    for (number, episode) in all.iter().enumerate() {
        let number = number as u64;
        let alone = all_rolled(rollout(3, true).roll(&mut Fixed([0, 2]), &jobs(number..number + 1))).unwrap();
        assert_eq!(alone, std::slice::from_ref(episode));
    }
    let tasks: std::collections::HashSet<_> = all.iter().map(|episode| episode.task).collect();
    assert_eq!(tasks.len(), 4, "20 uniform draws meet all four games");
}

#[test]
fn actions_are_mapped_back_through_the_decision_order() {
    // Game 1 is won by (a¹, a³) of the environment's agents. Rows play (a¹, a³), so it is won exactly
    // when agent 0 decides first; game 4 is won by (a¹, a¹) in either order.
    let jobs: Vec<Job> = (0..40).map(|number| Job { task: Some(0), ..jobs(number..number + 1)[0] }).collect();
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
fn an_end_at_the_time_limit_counts_as_what_is_asked_for() {
    let end = |rollout: Rollout, policy: &mut dyn Policy, time_limit| {
        let job = Job { task: Some(0), ..jobs(0..1)[0] };
        let rolled = rollout.with_time_limit(time_limit).roll(policy, &[job]);
        let episode = all_rolled(rolled).unwrap().remove(0);
        (episode.end, episode.won)
    };
    let [asked, cut, over] = [TimeLimit::Environment, TimeLimit::Truncated, TimeLimit::Terminated];
    // The matrix game itself ends on its last step, won or lost.
    let lost = |time_limit| end(rollout(1, true), &mut Fixed([0, 0]), time_limit);
    assert_eq!([asked, cut, over].map(lost), [(End::Terminated, false); 3]);
    let won = |time_limit| end(rollout(5, false), &mut Fixed([0, 2]), time_limit);
    assert_eq!([asked, cut, over].map(won), [(End::Terminated, true); 3]);
    // Particle worlds end for want of time alone. The original calls that over, and simple spread of mpe2 a cut.
    for set in [TaskSet::CooperativeNavigation, TaskSet::PredatorPrey, TaskSet::PredatorPreyPro] {
        let particles = |physics, time_limit| {
            let options = EnvironmentOptions { physics, ..EnvironmentOptions::default() };
            let worlds = Arc::new(Embedded(options));
            let rollout = Rollout::new(set.tasks(Split::Training), worlds, RunSeed(2), true);
            end(rollout, &mut Script::Random, time_limit).0
        };
        let of = |physics| [asked, cut, over].map(|time_limit| particles(physics, time_limit));
        assert_eq!(of(Physics::Original), [End::Terminated, End::Truncated, End::Terminated], "{set}");
        assert_eq!(of(Physics::Mpe2), [End::Truncated, End::Truncated, End::Terminated], "{set}");
    }
}

/// A battle whose last step ends it in this way.
struct LastStep {
    game: MatrixGame,
    end: End,
    won: bool,
    is_over_at_limit: bool,
}

impl Environment for LastStep {
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
        let step = self.game.step(actions, rng)?;
        Ok(Step { end: step.end.map(|_| self.end), won: self.won && step.end.is_some(), ..step })
    }

    fn is_over_at_limit(&self) -> bool {
        self.is_over_at_limit
    }
}

struct LastSteps(End, bool, bool);

impl EnvironmentFactory for LastSteps {
    fn build(&self, _: Task) -> Result<Box<dyn Environment>, EnvironmentError> {
        let Self(end, won, is_over_at_limit) = *self;
        Ok(Box::new(LastStep { game: MatrixGame::new(0), end, won, is_over_at_limit }))
    }
}

/// As in combat: a battle that is lost on the very step on which time is up is over, not cut off.
#[test]
fn a_defeat_on_the_last_step_is_no_cut() {
    let end = |world: LastSteps| {
        let tasks = TaskSet::MatrixGame.tasks(Split::Training);
        let rollout = Rollout::new(tasks, Arc::new(world), RunSeed(1), true);
        let rolled = rollout.with_time_limit(TimeLimit::Truncated).roll(&mut Fixed([0, 0]), &jobs(0..1));
        all_rolled(rolled).unwrap().remove(0).end
    };
    assert_eq!(end(LastSteps(End::Terminated, false, false)), End::Terminated, "lost");
    assert_eq!(end(LastSteps(End::Terminated, true, false)), End::Terminated, "won");
    assert_eq!(end(LastSteps(End::Truncated, false, false)), End::Truncated, "time is up");
    assert_eq!(
        end(LastSteps(End::Terminated, false, true)),
        End::Truncated,
        "time is up, and the world calls that over"
    );
    assert_eq!(
        end(LastSteps(End::Terminated, true, true)),
        End::Terminated,
        "won, whatever else it calls over"
    );
}

#[test]
fn a_watched_rollout_shows_every_state_of_the_same_episodes() {
    let set = TaskSet::PredatorPrey;
    let new = || Rollout::new(set.tasks(Split::Training), Arc::new(Embedded::default()), RunSeed(2), true);
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
            return Err(EnvironmentError::new(FailureKind::Died, "it broke"));
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
    let jobs: Vec<Job> = (0..1).map(|number| Job { task: Some(0), ..jobs(number..number + 1)[0] }).collect();
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

/// A matrix game that says how many of its kind are under way.
struct Counted {
    game: MatrixGame,
    under_way: Arc<AtomicUsize>,
}

impl Environment for Counted {
    fn spec(&self) -> Spec {
        MatrixGame::SPEC
    }

    fn reset(&mut self, rng: &mut Rng) -> Result<(), EnvironmentError> {
        self.game.reset(rng)
    }

    fn observe(&self, observation: &mut Observation) {
        self.game.observe(observation);
    }

    fn begin_step(&mut self, _: &[Action]) -> Result<(), EnvironmentError> {
        self.under_way.fetch_add(1, Ordering::Relaxed);
        Ok(())
    }

    fn step(&mut self, actions: &[Action], rng: &mut Rng) -> Result<Step, EnvironmentError> {
        self.under_way.fetch_sub(1, Ordering::Relaxed);
        self.game.step(actions, rng)
    }
}

struct CountedWorlds {
    under_way: Arc<AtomicUsize>,
    steps_elsewhere: bool,
}

impl EnvironmentFactory for CountedWorlds {
    fn build(&self, task: Task) -> Result<Box<dyn Environment>, EnvironmentError> {
        let Task::MatrixGame { game } = task else { panic!("{task} is no matrix game") };
        Ok(Box::new(Counted { game: MatrixGame::new(game), under_way: Arc::clone(&self.under_way) }))
    }

    fn steps_elsewhere(&self) -> bool {
        self.steps_elsewhere
    }
}

/// Notes at each of its turns for how many it chooses, and how many worlds are under way meanwhile.
struct Noting(Arc<AtomicUsize>, Vec<(usize, usize)>);

impl Policy for Noting {
    fn begin(&mut self, _: usize, _: usize) {}

    fn act(&mut self, turns: &mut [Turn<'_>]) {
        self.1.push((turns.len(), self.0.load(Ordering::Relaxed)));
        Fixed([0, 2]).act(turns);
    }
}

#[test]
fn worlds_elsewhere_step_while_the_policy_acts_and_episodes_are_the_same() {
    let jobs = jobs(0..5);
    let roll = |steps_elsewhere| {
        let under_way = Arc::<AtomicUsize>::default();
        let worlds = CountedWorlds { under_way: Arc::clone(&under_way), steps_elsewhere };
        let tasks = TaskSet::MatrixGame.tasks(Split::Training);
        let mut rollout = Rollout::new(tasks, Arc::new(worlds), RunSeed(3), true);
        let mut noting = Noting(under_way, Vec::new());
        (all_rolled(rollout.roll(&mut noting, &jobs)).unwrap(), noting.1)
    };
    let (episodes, noted) = roll(false);
    assert_eq!(noted, [(5, 0), (5, 0)], "two steps an episode");
    let (in_halves, noted) = roll(true);
    assert_eq!(noted, [(3, 0), (2, 3), (3, 2), (2, 3)]);
    assert_eq!(in_halves, episodes);
    assert_eq!(all_rolled(rollout(3, true).roll(&mut Fixed([0, 2]), &jobs)).unwrap(), episodes);
}
