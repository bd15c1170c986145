//! The lines of `metrics.jsonl` after its header.

use crate::{Measured, TaskResult, number};
use rit_env::Split;
use serde::{Deserialize, Deserializer, Serialize};
use serde_json::{Map, Value};
use std::collections::BTreeMap;

/// How far training has come.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct Progress {
    /// Environment steps collected.
    pub env_steps: u64,
    /// Episodes collected.
    pub episodes: u64,
    /// Updates made.
    pub updates: u64,
}

/// One line.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(tag = "kind", rename_all = "snake_case")]
pub enum Line {
    /// How training goes.
    Training(TrainingPoint),
    /// Greedy episodes.
    Evaluation(Evaluation),
    /// Of a kind that this build does not know.
    #[serde(untagged, skip_deserializing)]
    Other(Map<String, Value>),
}

/// How training goes, at one moment.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct TrainingPoint {
    /// How far it has come.
    #[serde(flatten)]
    pub progress: Progress,
    /// Seconds that learners have run.
    #[serde(default, deserialize_with = "number::or_nan")]
    pub wall_s: f64,
    /// ε of the episodes handed out now.
    #[serde(deserialize_with = "number::or_nan")]
    pub epsilon: f64,
    /// Exploring episodes of late, by task.
    #[serde(deserialize_with = "named")]
    pub tasks: BTreeMap<String, TaskResult>,
    /// What the last update reported. The last field: it takes the keys that no other has.
    #[serde(flatten)]
    pub measured: Measured,
}

/// Greedy episodes of some tasks, all of one split.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct Evaluation {
    /// How far training had come.
    #[serde(flatten)]
    pub progress: Progress,
    /// Seconds that learners had run.
    #[serde(default, deserialize_with = "number::or_nan")]
    pub wall_s: f64,
    /// Why it was made.
    #[serde(default, skip_serializing_if = "is_scheduled")]
    pub occasion: Occasion,
    /// Tasks of training, or those never seen in it.
    #[serde(default, skip_serializing_if = "is_training")]
    pub split: Split,
    /// Its results, by task.
    #[serde(deserialize_with = "named")]
    pub tasks: BTreeMap<String, TaskResult>,
    /// What this build does not know.
    #[serde(flatten)]
    pub other: Map<String, Value>,
}

/// Why an evaluation was made.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Occasion {
    /// It was due.
    #[default]
    Scheduled,
    /// The run came to its end: the last weights.
    Final,
    /// The run came to its end: the best weights, over ten times as many episodes. The absolute metric.
    Best,
}

fn is_scheduled(occasion: &Occasion) -> bool {
    *occasion == Occasion::Scheduled
}

fn is_training(split: &Split) -> bool {
    *split == Split::Training
}

/// Results that know their tasks' names.
pub(crate) fn named<'de, D: Deserializer<'de>>(
    deserializer: D,
) -> Result<BTreeMap<String, TaskResult>, D::Error> {
    let mut tasks = BTreeMap::<String, TaskResult>::deserialize(deserializer)?;
    tasks.iter_mut().for_each(|(task, result)| result.task.clone_from(task));
    Ok(tasks)
}

impl Line {
    /// Reads one line.
    ///
    /// # Errors
    /// When it is no object, or one of a kind that this build knows and not as that should be.
    pub fn parse(line: &[u8]) -> serde_json::Result<Self> {
        #[derive(Deserialize)]
        struct Kind {
            #[serde(default)]
            kind: String,
        }
        match serde_json::from_slice::<Kind>(line)?.kind.as_str() {
            "training" | "evaluation" => serde_json::from_slice(line),
            _ => serde_json::from_slice(line).map(Self::Other),
        }
    }

    /// How far training had come, where the line says so.
    pub fn progress(&self) -> Option<Progress> {
        match self {
            Self::Training(TrainingPoint { progress, .. })
            | Self::Evaluation(Evaluation { progress, .. }) => Some(*progress),
            Self::Other(_) => None,
        }
    }

    /// The same without single episodes.
    pub fn means(self) -> Self {
        match self {
            Self::Evaluation(evaluation) => {
                let tasks = evaluation.tasks.iter().map(|(task, result)| (task.clone(), result.means()));
                Self::Evaluation(Evaluation { tasks: tasks.collect(), ..evaluation })
            }
            line => line,
        }
    }
}

impl Evaluation {
    /// Of these results.
    pub fn new(
        progress: Progress,
        wall_s: f64,
        occasion: Occasion,
        split: Split,
        results: &[TaskResult],
    ) -> Self {
        let tasks = results.iter().map(|result| (result.task.clone(), result.clone())).collect();
        Self { progress, wall_s, occasion, split, tasks, other: Map::new() }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{EachEpisode, Exploring};

    fn result() -> TaskResult {
        let each = EachEpisode { returns: vec![1.0, 2.0], lengths: vec![3, 3], wins: vec![true, false] };
        TaskResult {
            task: "game-1".into(),
            episodes: 2,
            mean_return: 1.5,
            win_rate: Some(0.5),
            each: Some(each),
            exploring: None,
        }
    }

    fn progress() -> Progress {
        Progress { env_steps: 10, episodes: 5, updates: 2 }
    }

    #[track_caller]
    fn written(line: &Line, text: &str) {
        assert_eq!(serde_json::to_string(line).unwrap(), text);
        assert_eq!(&Line::parse(text.as_bytes()).unwrap(), line);
    }

    #[test]
    fn lines_are_as_ever_and_say_more_where_there_is_more() {
        let exploring = Some(Exploring { episodes_total: 9, policy_lag: 1 });
        let of_late = TaskResult { each: None, win_rate: None, exploring, ..result() };
        written(
            &Line::Training(TrainingPoint {
                progress: progress(),
                wall_s: 0.5,
                epsilon: 0.25,
                tasks: BTreeMap::from([("game-1".into(), of_late)]),
                measured: [("td_loss".to_owned(), 1e-9)].into_iter().collect(),
            }),
            concat!(
                r#"{"kind":"training","env_steps":10,"episodes":5,"updates":2,"wall_s":0.5,"epsilon":0.25,"tasks":{"game-1":"#,
                r#"{"episodes":2,"mean_return":1.5,"win_rate":null,"episodes_total":9,"policy_lag":1}},"td_loss":1e-9}"#
            ),
        );
        let results = [result()];
        let evaluation =
            |occasion, split| Line::Evaluation(Evaluation::new(progress(), 0.5, occasion, split, &results));
        let ending = concat!(
            r#""tasks":{"game-1":{"episodes":2,"mean_return":1.5,"win_rate":0.5,"returns":[1.0,2.0],"lengths":3,"#,
            r#""wins":"10"}}}"#
        );
        let begin = r#"{"kind":"evaluation","env_steps":10,"episodes":5,"updates":2,"wall_s":0.5,"#;
        written(&evaluation(Occasion::Scheduled, Split::Training), &format!("{begin}{ending}"));
        written(
            &evaluation(Occasion::Best, Split::Testing),
            &format!(r#"{begin}"occasion":"best","split":"testing",{ending}"#),
        );
    }

    #[test]
    fn what_this_build_does_not_know_is_kept() {
        let line = r#"{"kind":"evaluation","env_steps":1,"episodes":1,"updates":0,"wall_s":2.0,"tasks":{},"moon":[1,"x"]}"#;
        let parsed = Line::parse(line.as_bytes()).unwrap();
        assert_eq!(serde_json::to_string(&parsed).unwrap(), line);
        let other = r#"{"env_steps":3,"kind":"weather","sun":true}"#;
        let parsed = Line::parse(other.as_bytes()).unwrap();
        assert!(matches!(parsed, Line::Other(_)) && parsed.progress().is_none());
        assert_eq!(serde_json::to_string(&parsed).unwrap(), other);
    }

    #[test]
    fn a_known_kind_must_be_as_it_should() {
        for bad in [
            r#"{"kind":"evaluation","tasks":{}}"#,
            r#"{"kind":"evaluation","env_steps":1,"episodes":1,"updates":1}"#,
            r#"{"kind":"training","env_steps":1,"episodes":1,"updates":1,"epsilon":"low","tasks":{}}"#,
            "[1]",
            "",
        ] {
            assert!(Line::parse(bad.as_bytes()).is_err(), "{bad}");
        }
    }

    #[test]
    fn lines_of_older_builds_are_read() {
        let old = concat!(
            r#"{"kind":"evaluation","env_steps":50000,"episodes":2000,"updates":243,"#,
            r#""tasks":{"navigation-2-2":{"episodes":32,"mean_return":-119.616}}}"#
        );
        let Line::Evaluation(found) = Line::parse(old.as_bytes()).unwrap() else { panic!("{old}") };
        assert_eq!((found.occasion, found.split), (Occasion::Scheduled, Split::Training));
        let result = &found.tasks["navigation-2-2"];
        assert_eq!((result.task.as_str(), result.mean_return), ("navigation-2-2", -119.616));
    }
}
