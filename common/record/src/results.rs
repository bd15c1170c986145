//! What a policy reached on a task: means, and each episode where it is known.

use crate::number;
use serde::{Deserialize, Serialize};

/// What a policy reached on one task.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(try_from = "InFile", into = "InFile")]
pub struct TaskResult {
    /// The task's name; in files the key that the result stands under.
    pub task: String,
    /// Episodes it was measured over.
    pub episodes: u64,
    /// Mean of undiscounted returns.
    pub mean_return: f64,
    /// Share of episodes won, where the task knows winning.
    pub win_rate: Option<f64>,
    /// Each episode; of exploring episodes, and in files of older builds, only means are known.
    pub each: Option<EachEpisode>,
    /// Of exploring episodes: how the task goes on the whole.
    pub exploring: Option<Exploring>,
}

/// Episode by episode, in the order of their numbers.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct EachEpisode {
    /// Undiscounted returns.
    pub returns: Vec<f32>,
    /// Steps.
    pub lengths: Vec<u32>,
    /// Which were won; empty where the task knows no winning.
    pub wins: Vec<bool>,
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
    /// The same without its single episodes.
    pub fn means(&self) -> Self {
        Self { each: None, ..self.clone() }
    }

    /// Standard deviation of the returns of single episodes (with n − 1); none of fewer than two, or where only the mean
    /// is known.
    pub fn std_return(&self) -> Option<f64> {
        let returns = &self.each.as_ref()?.returns;
        if returns.len() < 2 {
            return None;
        }
        let count = returns.len() as f64;
        let mean = returns.iter().map(|&it| f64::from(it)).sum::<f64>() / count;
        let squares = returns.iter().map(|&it| (f64::from(it) - mean).powi(2)).sum::<f64>();
        Some((squares / (count - 1.0)).sqrt())
    }
}

/// Of more tasks a line has the mean alone.
const NAMED_MAX: usize = 10;

/// Results in a line of words.
pub fn in_words<'a>(results: impl IntoIterator<Item = &'a TaskResult>) -> String {
    let results: Vec<&TaskResult> = results.into_iter().collect();
    let said = |name: &str, mean_return: f64, win_rate: Option<f64>| match win_rate {
        Some(win_rate) => format!("{name} wins {win_rate:.2}"),
        None => format!("{name} {mean_return:.1}"),
    };
    if results.len() > NAMED_MAX {
        let count = results.len() as f64;
        let mean_return = results.iter().map(|it| it.mean_return).sum::<f64>() / count;
        let wins: Option<f64> = results.iter().map(|it| it.win_rate).sum();
        return said(&format!("mean of {} tasks", results.len()), mean_return, wins.map(|wins| wins / count));
    }
    let words = results.iter().map(|it| said(&it.task, it.mean_return, it.win_rate));
    words.collect::<Vec<_>>().join(", ")
}

/// A [`TaskResult`] as it stands in files.
#[derive(Clone, Serialize, Deserialize)]
struct InFile {
    episodes: u64,
    #[serde(deserialize_with = "number::or_nan")]
    mean_return: f64,
    #[serde(default)]
    win_rate: Option<f64>,
    #[serde(default, skip_serializing_if = "Option::is_none")]
    returns: Option<Values<f32>>,
    #[serde(default, skip_serializing_if = "Option::is_none")]
    lengths: Option<Values<u32>>,
    /// `1` for each episode that was won, `0` for each other.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    wins: Option<String>,
    #[serde(flatten)]
    exploring: Option<Exploring>,
}

/// Values of single episodes: one number where all are the same, which is what many tasks' lengths are.
#[derive(Clone, Serialize, Deserialize)]
#[serde(untagged)]
enum Values<T> {
    All(T),
    Each(Vec<Option<T>>),
}

impl<T: Copy + PartialEq> Values<T> {
    fn new(values: &[T]) -> Self {
        match values {
            [first, rest @ ..] if rest.iter().all(|value| value == first) => Self::All(*first),
            _ => Self::Each(values.iter().copied().map(Some).collect()),
        }
    }

    /// So many values; `none` stands for what is no number.
    fn expand(self, count: usize, none: T) -> Vec<T> {
        match self {
            Self::All(value) => vec![value; count],
            Self::Each(values) => values.into_iter().map(|value| value.unwrap_or(none)).collect(),
        }
    }
}

impl From<TaskResult> for InFile {
    fn from(result: TaskResult) -> Self {
        let TaskResult { episodes, mean_return, win_rate, each, exploring, .. } = result;
        let each = each.as_ref();
        let wins = each.filter(|each| !each.wins.is_empty());
        Self {
            episodes,
            mean_return,
            win_rate,
            returns: each.map(|each| Values::new(&each.returns)),
            lengths: each.map(|each| Values::new(&each.lengths)),
            wins: wins.map(|each| each.wins.iter().map(|&won| if won { '1' } else { '0' }).collect()),
            exploring,
        }
    }
}

impl TryFrom<InFile> for TaskResult {
    type Error = String;

    fn try_from(found: InFile) -> Result<Self, String> {
        let InFile { episodes, mean_return, win_rate, returns, lengths, wins, exploring } = found;
        // More are never rolled, and a slip of the pen takes no memory.
        let count = usize::try_from(episodes).ok().filter(|&count| count <= EPISODES_MAX);
        let each = match (returns, lengths, count) {
            (Some(returns), Some(lengths), Some(count)) => {
                let wins = wins.unwrap_or_default().chars().map(|won| won == '1').collect();
                let (returns, lengths) = (returns.expand(count, f32::NAN), lengths.expand(count, 0));
                let each = EachEpisode { returns, lengths, wins };
                let EachEpisode { returns, lengths, wins } = &each;
                let counts = [returns.len(), lengths.len()];
                if counts != [count; 2] || ![0, count].contains(&wins.len()) {
                    return Err(format!(
                        "of {count} episodes it has {} returns, {} lengths and {} wins",
                        returns.len(),
                        lengths.len(),
                        wins.len()
                    ));
                }
                Some(each)
            }
            _ => None,
        };
        Ok(Self { task: String::new(), episodes, mean_return, win_rate, each, exploring })
    }
}

/// Most episodes that a result says one by one.
const EPISODES_MAX: usize = 10_000_000;

#[cfg(test)]
mod tests {
    use super::*;

    fn result(returns: &[f32], lengths: &[u32], wins: &[bool]) -> TaskResult {
        let each = EachEpisode { returns: returns.to_vec(), lengths: lengths.to_vec(), wins: wins.to_vec() };
        let mean_return = returns.iter().map(|&it| f64::from(it)).sum::<f64>() / returns.len() as f64;
        TaskResult { episodes: returns.len() as u64, mean_return, each: Some(each), ..TaskResult::default() }
    }

    #[test]
    fn a_line_names_few_tasks_and_has_the_mean_of_many() {
        let named = |at: usize| TaskResult { task: format!("{at}z"), ..result(&[at as f32], &[1], &[]) };
        let few: Vec<TaskResult> = (0..2).map(named).collect();
        assert_eq!(in_words(&few), "0z 0.0, 1z 1.0");
        let many: Vec<TaskResult> =
            (0..11).map(|at| TaskResult { win_rate: Some(0.5), ..named(at) }).collect();
        assert_eq!(in_words(&many), "mean of 11 tasks wins 0.50");
    }

    #[track_caller]
    fn written(result: &TaskResult, text: &str) {
        assert_eq!(serde_json::to_string(result).unwrap(), text);
        assert_eq!(&serde_json::from_str::<TaskResult>(text).unwrap(), result);
    }

    #[test]
    fn single_episodes_are_written_short_and_come_back() {
        written(
            &result(&[0.25, -2.5], &[25, 25], &[]),
            r#"{"episodes":2,"mean_return":-1.125,"win_rate":null,"returns":[0.25,-2.5],"lengths":25}"#,
        );
        written(
            &TaskResult { win_rate: Some(0.5), ..result(&[88.0, 88.0], &[2, 1], &[true, false]) },
            r#"{"episodes":2,"mean_return":88.0,"win_rate":0.5,"returns":88.0,"lengths":[2,1],"wins":"10"}"#,
        );
    }

    #[test]
    fn means_alone_are_read_as_ever() {
        let old = r#"{"episodes":32,"mean_return":-255.851}"#;
        let found: TaskResult = serde_json::from_str(old).unwrap();
        let expected = TaskResult { episodes: 32, mean_return: -255.851, ..TaskResult::default() };
        assert_eq!(found, expected);
        assert_eq!(found.std_return(), None);
        let exploring =
            r#"{"episodes":9,"mean_return":4.5,"win_rate":null,"episodes_total":9,"policy_lag":1}"#;
        let found: TaskResult = serde_json::from_str(exploring).unwrap();
        assert_eq!(found.exploring, Some(Exploring { episodes_total: 9, policy_lag: 1 }));
    }

    #[test]
    fn what_is_no_number_makes_no_invalid_json() {
        for strange in [f32::NAN, f32::INFINITY, f32::NEG_INFINITY] {
            let text = serde_json::to_string(&result(&[strange, 1.0], &[1, 2], &[])).unwrap();
            let found: TaskResult = serde_json::from_str(&text).unwrap();
            assert!(found.mean_return.is_nan(), "{text}");
            let returns = &found.each.unwrap().returns;
            assert!(returns[0].is_nan() && returns[1] == 1.0, "{text}");
        }
    }

    #[test]
    fn counts_that_do_not_fit_are_refused() {
        let refused = |text: &str| serde_json::from_str::<TaskResult>(text).unwrap_err().to_string();
        let short = refused(r#"{"episodes":3,"mean_return":1,"returns":[1,1],"lengths":4,"wins":"11"}"#);
        assert!(short.starts_with("of 3 episodes it has 2 returns, 3 lengths and 2 wins"), "{short}");
        let endless = r#"{"episodes":18446744073709551615,"mean_return":1,"returns":1,"lengths":4}"#;
        assert_eq!(serde_json::from_str::<TaskResult>(endless).unwrap().each, None);
    }

    /// By hand: of 1, 2, 3, 4 the mean is 2.5, the squares are 2.25 + 0.25 + 0.25 + 2.25 = 5, 5 / 3 = 1.666…, whose root
    /// is 1.290994.
    #[test]
    fn spread_is_that_of_the_sample() {
        let result = result(&[1.0, 2.0, 3.0, 4.0], &[1; 4], &[]);
        assert!((result.std_return().unwrap() - 1.290_994).abs() < 1e-6);
        assert_eq!(self::result(&[1.0], &[1], &[]).std_return(), None);
    }
}
