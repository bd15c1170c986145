//! What a run leaves, as messages: the same numbers that stand in its files.

use rit_algo::learner::Measure;
use rit_env::Split;
use rit_proto::v1;
use rit_record::{Evaluation, Line, Measured, TaskResult, TrainingPoint};

/// A task's result.
pub fn task_result(result: &TaskResult) -> v1::TaskResult {
    v1::TaskResult {
        task: result.task.clone(),
        episodes: result.episodes,
        mean_return: result.mean_return,
        win_rate: result.win_rate,
        episodes_total: result.exploring.map(|exploring| exploring.episodes_total),
        policy_lag: result.exploring.map(|exploring| exploring.policy_lag),
    }
}

/// What an update reported, with what each number is according to `measures`.
pub fn measures(measured: &Measured, measures: &[Measure]) -> Vec<v1::Measure> {
    let help = |name: &str| measures.iter().find(|measure| measure.name == name).map(|measure| measure.help);
    let message = |(name, value): &(String, f64)| v1::Measure {
        name: name.clone(),
        value: *value,
        help: help(name).unwrap_or_default().to_owned(),
    };
    measured.values.iter().map(message).collect()
}

/// A line of metrics; nothing for one of a kind that this build does not know.
pub fn line(line: &Line) -> Option<v1::MetricsLine> {
    let (progress, wall_s, tasks, training, split) = match line {
        Line::Training(TrainingPoint { progress, wall_s, epsilon, tasks, measured }) => {
            let training = v1::Training { epsilon: *epsilon, measures: measures(measured, &[]) };
            (progress, wall_s, tasks, Some(training), Split::Training)
        }
        Line::Evaluation(Evaluation { progress, wall_s, tasks, split, .. }) => {
            (progress, wall_s, tasks, None, *split)
        }
        Line::Other(_) => return None,
    };
    Some(v1::MetricsLine {
        env_steps: progress.env_steps,
        episodes: progress.episodes,
        updates: progress.updates,
        wall_s: *wall_s,
        tasks: tasks.values().map(task_result).collect(),
        training,
        testing: split == Split::Testing,
    })
}

/// A line for tests.
#[cfg(test)]
pub(crate) fn line_of_test(env_steps: u64) -> Line {
    let exploring = Some(rit_record::Exploring { episodes_total: 7, policy_lag: 1 });
    let task = "game-1".to_owned();
    let result =
        TaskResult { task: task.clone(), episodes: 5, mean_return: 0.1, exploring, ..Default::default() };
    Line::Training(TrainingPoint {
        progress: rit_record::Progress { env_steps, episodes: 3, updates: 2 },
        wall_s: 0.5,
        epsilon: 0.1 + 0.2,
        tasks: [(task, result)].into(),
        measured: [("td_loss".to_owned(), 1e-9), ("target_mean".to_owned(), -3.0)].into_iter().collect(),
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_message_says_what_the_line_says() {
        let message = line(&line_of_test(9)).unwrap();
        let training = message.training.unwrap();
        assert_eq!((message.env_steps, message.episodes, message.updates), (9, 3, 2));
        let measures: Vec<_> = training.measures.iter().map(|it| (it.name.as_str(), it.value)).collect();
        assert_eq!((measures, training.epsilon), (vec![("td_loss", 1e-9), ("target_mean", -3.0)], 0.1 + 0.2));
        let [task] = &message.tasks[..] else { panic!("{:?}", message.tasks) };
        assert_eq!((task.task.as_str(), task.episodes, task.policy_lag), ("game-1", 5, Some(1)));
        assert_eq!(line(&Line::Other(serde_json::Map::new())), None);
    }

    #[test]
    fn a_measure_is_told_with_what_it_is() {
        let measured = [("td_loss".to_owned(), 0.5), ("grad_norm".to_owned(), 1e-9)].into_iter().collect();
        let messages = measures(&measured, &[Measure { name: "grad_norm", help: "Gradient norm" }]);
        let told: Vec<_> = messages.iter().map(|it| (it.name.as_str(), it.value, it.help.as_str())).collect();
        assert_eq!(told, [("td_loss", 0.5, ""), ("grad_norm", 1e-9, "Gradient norm")]);
    }
}
