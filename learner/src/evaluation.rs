//! Greedy episodes of given tasks: how good the weights are.

use rit_config::Config;
use rit_env::{
    Environment, EnvironmentFactory, Split, Task, TaskError, TaskSet,
    rollout::{Job, LostEpisode, Rollout, all_rolled},
};
use rit_episode::{Choice, Episode, Policy, RunSeed};
use rit_record::{EachEpisode, TaskResult};
use std::{
    ops::Range,
    panic::resume_unwind,
    sync::{
        Arc, Mutex, PoisonError,
        atomic::{AtomicBool, Ordering},
    },
    thread,
};

/// Episodes rolled side by side, at most and at least: fewer cost more, more leave threads without any.
const SIDE_BY_SIDE: Range<usize> = 8..32;

/// Why there is nothing to evaluate.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
pub enum TasksError {
    /// No such task.
    #[error(transparent)]
    Unknown(#[from] TaskError),
    /// A task set without tasks that are kept for testing.
    #[error("{task_set} has no testing tasks; write training, or names of its tasks: {}", known.join(", "))]
    NoTesting {
        /// The task set.
        task_set: TaskSet,
        /// Its tasks.
        known: Vec<String>,
    },
}

/// What all evaluations of a run share.
#[derive(Clone)]
pub struct Evaluator {
    task_set: TaskSet,
    /// Training tasks and testing tasks.
    tasks: [Vec<Task>; 2],
    factory: Arc<dyn EnvironmentFactory>,
    random_permutation: bool,
    lost_rounds_max: usize,
    episodes: usize,
    testing_episodes: usize,
}

impl Evaluator {
    /// Of a run's configuration, with worlds of their own.
    pub fn new(config: &Config) -> Self {
        Self::with_factory(config, rit_worlds::factory(config))
    }

    /// Of a run's configuration, with worlds of this factory.
    pub fn with_factory(config: &Config, factory: Arc<dyn EnvironmentFactory>) -> Self {
        Self {
            task_set: config.environment.task_set,
            tasks: [Split::Training, Split::Testing].map(|split| config.tasks(split)),
            factory,
            random_permutation: config.algorithm.random_permutation,
            lost_rounds_max: config.environment.lost_rounds_max,
            episodes: config.evaluation.episodes,
            testing_episodes: config.evaluation.testing_episodes,
        }
    }

    /// Greedy episodes of a task where no other number is asked for: `evaluation.testing_episodes` of a testing task,
    /// `evaluation.episodes` of the others.
    pub fn own_episodes(&self, task: Task) -> usize {
        let is_testing = self.tasks[1].contains(&task);
        if is_testing { self.testing_episodes } else { self.episodes }
    }

    /// The tasks of `training`, `testing`, or of names of tasks, each once however often it is
    /// named; the training tasks where nothing is named.
    ///
    /// # Errors
    /// When a name means nothing, or there are no testing tasks.
    pub fn tasks(&self, names: &[String]) -> Result<Vec<Task>, TasksError> {
        let [training, testing] = &self.tasks;
        if names.is_empty() {
            return Ok(training.clone());
        }
        let mut tasks: Vec<Task> = Vec::new();
        for name in names {
            let named = match name.as_str() {
                "training" => training.clone(),
                "testing" if testing.is_empty() => {
                    let known = training.iter().map(Task::to_string).collect();
                    return Err(TasksError::NoTesting { task_set: self.task_set, known });
                }
                "testing" => testing.clone(),
                name => vec![self.task_set.task(name)?],
            };
            for task in named {
                if !tasks.contains(&task) {
                    tasks.push(task);
                }
            }
        }
        Ok(tasks)
    }

    /// Rolls greedy episodes of each task, so many of each as are asked for or as the run has of its own: on as many
    /// threads as there are policies, all of which must be the same. The same seed rolls the same episodes, on however
    /// many. Those that are lost are rolled again.
    ///
    /// # Errors
    /// When environments fail again and again.
    pub fn evaluate(
        &self,
        policies: &mut [&mut dyn Policy],
        tasks: &[Task],
        asked: Option<usize>,
        seed: RunSeed,
    ) -> Result<Vec<TaskResult>, LostEpisode> {
        // It is never given up.
        self.evaluate_unless(policies, tasks, asked, seed, &|| false).map(Option::unwrap_or_default)
    }

    /// [`Self::evaluate`], given up within a few episodes once it is no longer wanted: then `None`.
    ///
    /// # Errors
    /// When environments fail again and again.
    pub fn evaluate_unless(
        &self,
        policies: &mut [&mut dyn Policy],
        tasks: &[Task],
        asked: Option<usize>,
        seed: RunSeed,
        given_up: &(dyn Fn() -> bool + Sync),
    ) -> Result<Option<Vec<TaskResult>>, LostEpisode> {
        let counts = tasks.iter().map(|&task| asked.unwrap_or_else(|| self.own_episodes(task)));
        let wanted: Vec<(Task, usize)> = tasks.iter().copied().zip(counts).collect();
        let threads = policies.len().min(self.factory.worlds_max()).max(1);
        let policies = &mut policies[..threads];
        let parts = parts(&wanted, threads, self.factory.worlds_max());
        let (work, over) = (Mutex::new(parts.into_iter().enumerate()), AtomicBool::new(false));
        let roll = |policy: &mut dyn Policy| self.roll_parts(policy, &work, seed, &over, given_up);
        let rolled = match policies {
            [policy] => vec![roll(*policy)],
            policies => thread::scope(|scope| {
                let threads: Vec<_> =
                    policies.iter_mut().map(|policy| scope.spawn(|| roll(&mut **policy))).collect();
                threads
                    .into_iter()
                    .map(|thread| thread.join().unwrap_or_else(|panic| resume_unwind(panic)))
                    .collect()
            }),
        };
        // The next evaluation may be long in coming.
        self.factory.rest();
        let mut rolled: Vec<Rolled> = rolled.into_iter().collect::<Result<Vec<_>, _>>()?.concat();
        if over.into_inner() {
            return Ok(None);
        }
        rolled.sort_by_key(|part| part.number);
        let result = |(at, &(task, count)): (usize, &(Task, usize))| {
            let episodes = rolled.iter().filter(|part| part.task == at).flat_map(|part| &part.episodes);
            result(task, count, self.factory.spec(task).has_wins, episodes)
        };
        Ok(Some(wanted.iter().enumerate().map(result).collect()))
    }

    /// Rolls those episodes of these numbers that [`Self::evaluate`] rolls of a task with this seed, and shows
    /// their worlds to `watch`; see [`Rollout::roll_watched`].
    ///
    /// # Errors
    /// When an environment cannot go on.
    pub fn watch(
        &self,
        policy: &mut dyn Policy,
        task: Task,
        numbers: Range<u64>,
        seed: RunSeed,
        watch: impl FnMut(usize, &dyn Environment),
    ) -> Result<Vec<Episode>, LostEpisode> {
        all_rolled(self.rollout(task, seed).roll_watched(policy, &jobs(numbers), watch))
    }

    fn rollout(&self, task: Task, seed: RunSeed) -> Rollout {
        let seed = seed.derive(&task.to_string(), 0);
        Rollout::new(vec![task], Arc::clone(&self.factory), seed, self.random_permutation)
            .with_lost_rounds_max(self.lost_rounds_max)
    }

    /// Rolls parts of the work until there is none, or it is no longer wanted: then it is `over` for all.
    fn roll_parts(
        &self,
        policy: &mut dyn Policy,
        work: &Mutex<impl Iterator<Item = (usize, Part)>>,
        seed: RunSeed,
        over: &AtomicBool,
        given_up: &(dyn Fn() -> bool + Sync),
    ) -> Result<Vec<Rolled>, LostEpisode> {
        let (mut rolled, mut rollout) = (Vec::new(), None::<(Task, Rollout)>);
        let next = || work.lock().unwrap_or_else(PoisonError::into_inner).next();
        while !over.load(Ordering::Relaxed) {
            let Some((number, Part { task, at, numbers })) = next() else { break };
            if given_up() {
                over.store(true, Ordering::Relaxed);
                break;
            }
            let rollout = match &mut rollout {
                Some((of, rollout)) if *of == task => rollout,
                other => &mut other.insert((task, self.rollout(task, seed))).1,
            };
            let episodes = rollout
                .roll_all(policy, &jobs(numbers))
                .inspect_err(|_| over.store(true, Ordering::Relaxed))?;
            let facts = |episode: Episode| (episode.total_reward(), episode.steps() as u32, episode.won);
            rolled.push(Rolled { number, task: at, episodes: episodes.into_iter().map(facts).collect() });
        }
        Ok(rolled)
    }
}

/// Episodes of one task that one thread rolls side by side.
#[derive(Debug)]
struct Part {
    task: Task,
    /// The task's place among those evaluated.
    at: usize,
    numbers: Range<u64>,
}

/// The episodes of a part: return, steps, whether it was won.
#[derive(Clone, Debug)]
struct Rolled {
    /// The part's place in the work.
    number: usize,
    task: usize,
    episodes: Vec<(f64, u32, bool)>,
}

/// All that is to be rolled, in parts small enough that every thread has several, and that all threads together play in no
/// more worlds than there may be.
fn parts(wanted: &[(Task, usize)], threads: usize, worlds_max: usize) -> Vec<Part> {
    let count = |size: usize| wanted.iter().map(|(_, episodes)| episodes.div_ceil(size)).sum::<usize>();
    let mut size = (worlds_max / threads).clamp(1, SIDE_BY_SIDE.end);
    while threads > 1 && size > SIDE_BY_SIDE.start && count(size) < 2 * threads {
        size /= 2;
    }
    let of_task = |(at, &(task, episodes)): (usize, &(Task, usize))| {
        let begins = (0..episodes).step_by(size);
        begins.map(move |begin| Part { task, at, numbers: begin as u64..(begin + size).min(episodes) as u64 })
    };
    wanted.iter().enumerate().flat_map(of_task).collect()
}

/// What the episodes of a task, in the order of their numbers, come to.
fn result<'a>(
    task: Task,
    count: usize,
    has_wins: bool,
    episodes: impl Iterator<Item = &'a (f64, u32, bool)>,
) -> TaskResult {
    let (mut total, mut won, mut each) = (0.0, 0, EachEpisode::default());
    for &(episode_return, steps, episode_won) in episodes {
        total += episode_return;
        won += usize::from(episode_won);
        each.returns.push(episode_return as f32);
        each.lengths.push(steps);
        each.wins.extend(has_wins.then_some(episode_won));
    }
    let share = |sum: f64| sum / count as f64;
    TaskResult {
        task: task.to_string(),
        episodes: count as u64,
        mean_return: share(total),
        win_rate: has_wins.then(|| share(won as f64)),
        each: Some(each),
        exploring: None,
    }
}

/// Greedy episodes of these numbers of a rollout's one task.
fn jobs(numbers: Range<u64>) -> Vec<Job> {
    let job = |number| Job { number, weights_version: 0, choice: Choice::Greedy, task: Some(0) };
    numbers.map(job).collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use rit_env::Script;
    use rit_episode::Turn;
    use std::sync::atomic::AtomicUsize;

    /// Plays what wins game 4 of the matrix games, in any order.
    #[derive(Clone)]
    struct FirstAction;

    impl Policy for FirstAction {
        fn begin(&mut self, _: usize, _: usize) {}

        fn act(&mut self, turns: &mut [Turn<'_>]) {
            turns.iter_mut().for_each(|turn| turn.actions.fill(0));
        }
    }

    #[test]
    fn counts_returns_and_wins_by_task() {
        let config = rit_config::resolve("environment.task_set = \"matrix-game\"", "test", &[]).unwrap();
        let evaluator = Evaluator::new(&config);
        let tasks = evaluator.tasks(&["game-4".into(), "game-2".into()]).unwrap();
        let results = evaluator.evaluate(&mut [&mut FirstAction], &tasks, Some(70), RunSeed(1)).unwrap();
        let facts: Vec<_> =
            results.iter().map(|r| (r.task.as_str(), r.episodes, r.mean_return, r.win_rate)).collect();
        assert_eq!(facts, [("game-4", 70, 106.0, Some(1.0)), ("game-2", 70, -18.0, Some(0.0))]);
        assert_eq!(evaluator.tasks(&[]).unwrap().len(), 4);
        let none = evaluator.tasks(&["testing".into()]).unwrap_err().to_string();
        assert!(none.starts_with("matrix-game has no testing tasks; write training, or names of"), "{none}");
        assert!(
            evaluator.tasks(&["game-5".into()]).unwrap_err().to_string().contains("known: game-1, game-2")
        );
    }

    #[test]
    fn a_testing_task_has_a_number_of_episodes_of_its_own() {
        let settings = ["evaluation.episodes=2", "evaluation.testing_episodes=3"];
        let settings: Vec<_> = settings.iter().map(|text| rit_config::set(text).unwrap()).collect();
        let text = "environment.task_set = \"predator-prey\"";
        let evaluator = Evaluator::new(&rit_config::resolve(text, "test", &settings).unwrap());
        let tasks = evaluator.tasks(&["training".into(), "testing".into()]).unwrap();
        let counts = |asked| {
            let results = evaluator.evaluate(&mut [&mut Script::Still], &tasks, asked, RunSeed(1)).unwrap();
            results.iter().map(|result| result.episodes).collect::<Vec<_>>()
        };
        let (training, testing) = (
            counts(None).iter().filter(|&&n| n == 2).count(),
            counts(None).iter().filter(|&&n| n == 3).count(),
        );
        assert_eq!(training, evaluator.tasks(&[]).unwrap().len());
        assert_eq!((training + testing, testing > 0), (tasks.len(), true));
        assert_eq!(counts(Some(1)), vec![1; tasks.len()]);
    }

    #[test]
    fn a_task_that_is_named_again_and_again_is_one_task() {
        let config = rit_config::resolve("environment.task_set = \"matrix-game\"", "test", &[]).unwrap();
        let evaluator = Evaluator::new(&config);
        let mut names = vec!["game-2".to_owned(); 3000];
        names.extend(["training".to_owned(), "game-3".to_owned()]);
        let tasks: Vec<_> = evaluator.tasks(&names).unwrap().iter().map(ToString::to_string).collect();
        assert_eq!(tasks, ["game-2", "game-1", "game-3", "game-4"]);
    }

    #[test]
    fn a_cancelled_evaluation_ends_within_a_few_episodes() {
        let config = rit_config::resolve("environment.task_set = \"matrix-game\"", "test", &[]).unwrap();
        let evaluator = Evaluator::new(&config);
        let tasks = evaluator.tasks(&[]).unwrap();
        for threads in [1, 3] {
            let looks = AtomicUsize::new(0);
            let given_up = || looks.fetch_add(1, Ordering::Relaxed) >= 3;
            let mut policies = vec![FirstAction; threads];
            let mut policies: Vec<_> = policies.iter_mut().map(|policy| policy as &mut dyn Policy).collect();
            let results =
                evaluator.evaluate_unless(&mut policies, &tasks, Some(1_000_000), RunSeed(1), &given_up);
            assert!(results.unwrap().is_none());
            assert!((4..4 + threads).contains(&looks.into_inner()), "each thread looks once more at most");
        }
    }

    #[test]
    fn threads_share_the_work_and_change_nothing() {
        let text = "environment.task_set = \"cooperative-navigation\"";
        let config = rit_config::resolve(text, "test", &[]).unwrap();
        let evaluator = Evaluator::new(&config);
        let tasks = evaluator.tasks(&["training".into(), "testing".into()]).unwrap();
        let evaluate = |threads: usize| {
            let mut policies = vec![Script::Still; threads];
            let mut policies: Vec<_> = policies.iter_mut().map(|policy| policy as &mut dyn Policy).collect();
            evaluator.evaluate(&mut policies, &tasks, Some(37), RunSeed(1)).unwrap()
        };
        let one = evaluate(1);
        let each = one[0].each.as_ref().unwrap();
        assert_eq!((each.returns.len(), each.lengths.clone(), each.wins.len()), (37, vec![25; 37], 0));
        assert!(one.iter().any(|result| result.std_return() > Some(0.0)), "{one:?}");
        for threads in [2, 3, 16] {
            assert_eq!(evaluate(threads), one, "{threads}");
        }
    }

    #[test]
    fn every_thread_gets_several_parts_where_there_are_enough_episodes() {
        let task = TaskSet::MatrixGame.tasks(Split::Training)[0];
        let sizes_within = |episodes: &[usize], threads, worlds_max| {
            let wanted: Vec<_> = episodes.iter().map(|&episodes| (task, episodes)).collect();
            parts(&wanted, threads, worlds_max)
                .iter()
                .map(|part| part.numbers.end - part.numbers.start)
                .collect::<Vec<_>>()
        };
        let sizes = |episodes: &[usize], threads| sizes_within(episodes, threads, usize::MAX);
        assert_eq!(sizes(&[70], 1), [32, 32, 6]);
        assert_eq!(sizes(&[32, 32, 32], 2), [16; 6]);
        assert_eq!(sizes(&[160, 160], 2), [32; 10]);
        assert_eq!(sizes(&[10], 8), [8, 2]);
        assert_eq!(sizes(&[], 8), [0; 0]);
        assert_eq!(sizes_within(&[10], 2, 5), [2; 5], "games that are few");
        assert_eq!(sizes_within(&[2], 1, 1), [1, 1]);
    }

    #[test]
    fn watched_episodes_are_those_that_are_measured() {
        let config = rit_config::resolve("environment.task_set = \"predator-prey\"", "test", &[]).unwrap();
        let evaluator = Evaluator::new(&config);
        let task = evaluator.tasks(&["predator-prey-3-2".into()]).unwrap()[0];
        let mut states = [0; 4];
        let watched = evaluator
            .watch(&mut Script::Chase, task, 0..4, RunSeed(1), |episode, _| states[episode] += 1)
            .unwrap();
        let measured = evaluator.evaluate(&mut [&mut Script::Chase], &[task], Some(4), RunSeed(1)).unwrap();
        let mean = watched.iter().map(Episode::total_reward).sum::<f64>() / 4.0;
        assert_eq!((mean, states), (measured[0].mean_return, [26; 4]));
        let last = evaluator.watch(&mut Script::Chase, task, 3..4, RunSeed(1), |_, _| {}).unwrap();
        assert_eq!(last, watched[3..], "its number makes an episode what it is");
    }
}
