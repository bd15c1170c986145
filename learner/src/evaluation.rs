//! Greedy episodes of given tasks: how good the weights are.

use rit_config::Config;
use rit_env::{
    Environment, EnvironmentFactory, Split, Task, TaskError, TaskSet,
    rollout::{Job, LostEpisode, Rollout, all_rolled},
};
use rit_episode::{Choice, Episode, Policy, RunSeed};
use rit_proto::v1;
use serde::{Deserialize, Serialize};
use std::{collections::BTreeMap, ops::Range, sync::Arc};

/// Episodes rolled side by side.
const SIDE_BY_SIDE: usize = 32;

/// What a policy reached on one task.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct TaskResult {
    /// The task's name.
    #[serde(skip)]
    pub task: String,
    /// Episodes it was measured over.
    pub episodes: u64,
    /// Mean of undiscounted returns.
    pub mean_return: f64,
    /// Share of episodes won, where the task knows winning.
    pub win_rate: Option<f64>,
    /// Of exploring episodes: how the task goes on the whole.
    #[serde(flatten)]
    pub exploring: Option<Exploring>,
}

/// How the exploring episodes of a task came in.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct Exploring {
    /// All that were collected.
    pub episodes_total: u64,
    /// Weights version of the learner minus that of the newest one, when it entered replay.
    pub policy_lag: u64,
}

impl TaskResult {
    /// As a message.
    pub fn to_message(&self) -> v1::TaskResult {
        v1::TaskResult {
            task: self.task.clone(),
            episodes: self.episodes,
            mean_return: self.mean_return,
            win_rate: self.win_rate,
            episodes_total: self.exploring.map(|exploring| exploring.episodes_total),
            policy_lag: self.exploring.map(|exploring| exploring.policy_lag),
        }
    }
}

/// Results by task, as they stand in files.
pub fn by_task(results: &[TaskResult]) -> BTreeMap<String, TaskResult> {
    results.iter().map(|result| (result.task.clone(), result.clone())).collect()
}

/// Results in a line of words.
pub fn in_words(results: &[TaskResult]) -> String {
    let words = results.iter().map(|result| match result.win_rate {
        Some(win_rate) => format!("{} wins {win_rate:.2}", result.task),
        None => format!("{} {:.1}", result.task, result.mean_return),
    });
    words.collect::<Vec<_>>().join(", ")
}

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
            episodes: config.evaluation.episodes,
            testing_episodes: config.evaluation.testing_episodes,
        }
    }

    /// Greedy episodes of a task where nobody asks for another number: `evaluation.testing_episodes` of a testing task,
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

    /// Rolls greedy episodes of each task, so many of each as are asked for or as the run has of its own. Those that are
    /// lost are rolled again.
    ///
    /// # Errors
    /// When environments fail again and again.
    pub fn evaluate_own(
        &self,
        policy: &mut dyn Policy,
        tasks: &[Task],
        asked: Option<usize>,
        seed: RunSeed,
    ) -> Result<Vec<TaskResult>, LostEpisode> {
        // Nobody gives it up.
        self.evaluate_unless(policy, tasks, asked, seed, &|| false).map(Option::unwrap_or_default)
    }

    /// Rolls so many greedy episodes of each task. The same seed rolls the same episodes.
    ///
    /// # Errors
    /// When environments fail again and again.
    pub fn evaluate(
        &self,
        policy: &mut dyn Policy,
        tasks: &[Task],
        episodes: usize,
        seed: RunSeed,
    ) -> Result<Vec<TaskResult>, LostEpisode> {
        self.evaluate_own(policy, tasks, Some(episodes), seed)
    }

    /// [`Self::evaluate_own`], given up within a few episodes once nobody wants it any more: then `None`.
    ///
    /// # Errors
    /// When environments fail again and again.
    pub fn evaluate_unless(
        &self,
        policy: &mut dyn Policy,
        tasks: &[Task],
        asked: Option<usize>,
        seed: RunSeed,
        given_up: &dyn Fn() -> bool,
    ) -> Result<Option<Vec<TaskResult>>, LostEpisode> {
        let mut results = Vec::with_capacity(tasks.len());
        for &task in tasks {
            let episodes = asked.unwrap_or_else(|| self.own_episodes(task));
            let Some(result) = self.evaluate_task(policy, task, episodes, seed, given_up)? else {
                return Ok(None);
            };
            results.push(result);
        }
        // The next evaluation may be long in coming.
        self.factory.rest();
        Ok(Some(results))
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
    }

    fn evaluate_task(
        &self,
        policy: &mut dyn Policy,
        task: Task,
        episodes: usize,
        seed: RunSeed,
        given_up: &dyn Fn() -> bool,
    ) -> Result<Option<TaskResult>, LostEpisode> {
        let mut rollout = self.rollout(task, seed);
        let (mut total, mut won) = (0.0, 0);
        let side_by_side = SIDE_BY_SIDE.min(self.factory.worlds_max()).max(1);
        for begin in (0..episodes as u64).step_by(side_by_side) {
            if given_up() {
                return Ok(None);
            }
            let numbers = begin..(begin + side_by_side as u64).min(episodes as u64);
            for episode in rollout.roll_all(policy, &jobs(numbers))? {
                total += episode.total_reward();
                won += usize::from(episode.won);
            }
        }
        let share = |sum: f64| sum / episodes as f64;
        Ok(Some(TaskResult {
            task: task.to_string(),
            episodes: episodes as u64,
            mean_return: share(total),
            win_rate: self.factory.spec(task).has_wins.then(|| share(won as f64)),
            exploring: None,
        }))
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

    /// Plays what wins game 4 of the matrix games, in any order.
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
        let results = evaluator.evaluate(&mut FirstAction, &tasks, 70, RunSeed(1)).unwrap();
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
            let results = evaluator.evaluate_own(&mut Script::Still, &tasks, asked, RunSeed(1)).unwrap();
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
    fn what_nobody_wants_any_more_ends_within_a_few_episodes() {
        let config = rit_config::resolve("environment.task_set = \"matrix-game\"", "test", &[]).unwrap();
        let evaluator = Evaluator::new(&config);
        let tasks = evaluator.tasks(&[]).unwrap();
        let looks = std::cell::Cell::new(0);
        let given_up = || looks.replace(looks.get() + 1) == 3;
        let results =
            evaluator.evaluate_unless(&mut FirstAction, &tasks, Some(1_000_000_000), RunSeed(1), &given_up);
        assert!(results.unwrap().is_none() && looks.get() == 4, "{}", looks.get());
    }

    #[test]
    fn whoever_watches_sees_the_episodes_that_are_measured() {
        let config = rit_config::resolve("environment.task_set = \"predator-prey\"", "test", &[]).unwrap();
        let evaluator = Evaluator::new(&config);
        let task = evaluator.tasks(&["predator-prey-3-2".into()]).unwrap()[0];
        let mut states = [0; 4];
        let watched = evaluator
            .watch(&mut Script::Chase, task, 0..4, RunSeed(1), |episode, _| states[episode] += 1)
            .unwrap();
        let measured = evaluator.evaluate(&mut Script::Chase, &[task], 4, RunSeed(1)).unwrap();
        let mean = watched.iter().map(Episode::total_reward).sum::<f64>() / 4.0;
        assert_eq!((mean, states), (measured[0].mean_return, [26; 4]));
        let last = evaluator.watch(&mut Script::Chase, task, 3..4, RunSeed(1), |_, _| {}).unwrap();
        assert_eq!(last, watched[3..], "its number makes an episode what it is");
    }
}
