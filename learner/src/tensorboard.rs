//! TensorBoard event files: the scalars of `metrics.jsonl` over environment steps.
//!
//! A file is a row of TFRecords: length (u64), its masked CRC-32C, data, the data's masked CRC-32C, all
//! little-endian; the data is a protobuf `Event`. Each learner writes a file of its own. One that goes on from a
//! checkpoint first cuts away what was written behind it, so that there is one point a step. Each file begins with a
//! session's start: a TensorBoard that is running then forgets what it had seen from that step on.

use crate::{append_file::AppendFile, evaluation::TaskResult, metrics::Line};
use crc::{CRC_32_ISCSI, Crc};
use prost::Message;
use serde::{Deserialize, Serialize};
use std::{
    collections::BTreeMap,
    fs::{self, DirBuilder, OpenOptions},
    io,
    os::unix::fs::{DirBuilderExt as _, OpenOptionsExt as _},
    path::Path,
    time::{SystemTime, UNIX_EPOCH},
};

/// What TensorBoard knows event files by; seconds since 1970 follow, so that names sort by time.
const PREFIX: &str = "events.out.tfevents.";

const CRC: Crc<u32> = Crc::<u32>::new(&CRC_32_ISCSI);

/// How far the event files go: what a checkpoint remembers.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct Position {
    /// The newest file's name.
    pub file: String,
    /// Its length in bytes.
    pub len: u64,
}

/// Writes one event file.
#[derive(Debug)]
pub struct EventFile {
    file: AppendFile,
    name: String,
}

impl EventFile {
    /// Begins a file in this folder, behind what lay there at `position`. Files and records behind that were
    /// written by a learner that died, and will be written again: the first line to come has `from_env_steps` or
    /// more.
    ///
    /// # Errors
    /// When the folder or a file cannot be written.
    pub fn create(folder: &Path, position: &Position, from_env_steps: u64) -> io::Result<Self> {
        DirBuilder::new().recursive(true).mode(0o700).create(folder)?;
        let mut newest = 0;
        for entry in fs::read_dir(folder)? {
            let name = entry?.file_name();
            let Some(number) = name.to_str().and_then(|name| name.strip_prefix(PREFIX)?.parse::<u64>().ok())
            else {
                continue;
            };
            let path = folder.join(&name);
            if name.to_str() > Some(position.file.as_str()) {
                fs::remove_file(path)?;
            } else if name.to_str() == Some(position.file.as_str()) {
                let file = OpenOptions::new().write(true).open(path)?;
                file.set_len(position.len.min(file.metadata()?.len()))?;
            }
            newest = newest.max(number);
        }
        let name = format!("{PREFIX}{:010}", (wall_time() as u64).max(newest.saturating_add(1)));
        let path = folder.join(&name);
        let file = OpenOptions::new().write(true).create_new(true).mode(0o600).open(&path)?;
        let mut events = Self { file: AppendFile::new(path, file, 0)?, name };
        events.append(0, What::FileVersion("brain.Event:2".into()));
        let start = SessionLog { status: SessionStatus::Start.into() };
        events.append(from_env_steps, What::SessionLog(start));
        events.file.flush()?;
        Ok(events)
    }

    /// How far the files go.
    pub fn position(&self) -> Position {
        Position { file: self.name.clone(), len: self.file.written() }
    }

    /// Writes what a line says, or keeps it until the disk takes it.
    pub fn write(&mut self, line: &Line) {
        self.append(line.progress().env_steps, What::Summary(summary(line)));
    }

    /// Writes what the disk has refused so far.
    ///
    /// # Errors
    /// When it refuses again.
    pub fn flush(&mut self) -> io::Result<()> {
        self.file.flush()
    }

    fn append(&mut self, env_steps: u64, what: What) {
        let event = Event { wall_time: wall_time(), step: env_steps as i64, what: Some(what) };
        self.file.append(&record(&event.encode_to_vec()));
    }
}

/// Seconds since 1970.
fn wall_time() -> f64 {
    SystemTime::now().duration_since(UNIX_EPOCH).map_or(0.0, |since| since.as_secs_f64())
}

fn record(data: &[u8]) -> Vec<u8> {
    let len = (data.len() as u64).to_le_bytes();
    [&len[..], &masked_crc(&len), data, &masked_crc(data)].concat()
}

fn masked_crc(data: &[u8]) -> [u8; 4] {
    CRC.checksum(data).rotate_right(15).wrapping_add(0xa282_ead8).to_le_bytes()
}

fn summary(line: &Line) -> Summary {
    let mut value = Vec::new();
    let mut scalar = |tag: String, number: f64| value.push(Value { tag, simple_value: Some(number as f32) });
    let (group, tasks): (&str, &BTreeMap<String, TaskResult>) = match line {
        Line::Training { epsilon, measured, tasks, progress, .. } => {
            for (name, number) in &measured.0 {
                scalar(format!("training/{name}"), *number);
            }
            for (name, number) in [
                ("epsilon", *epsilon),
                ("episodes", progress.episodes as f64),
                ("updates", progress.updates as f64),
            ] {
                scalar(format!("training/{name}"), number);
            }
            ("exploring", tasks)
        }
        Line::Evaluation { tasks, .. } => ("greedy", tasks),
    };
    for (task, result) in tasks {
        scalar(format!("{group}_return/{task}"), result.mean_return);
        if let Some(win_rate) = result.win_rate {
            scalar(format!("{group}_win_rate/{task}"), win_rate);
        }
        if let Some(exploring) = result.exploring {
            scalar(format!("policy_lag/{task}"), exploring.policy_lag as f64);
            scalar(format!("episodes/{task}"), exploring.episodes_total as f64);
        }
    }
    Summary { value }
}

/// The fields of TensorFlow's `event.proto` and `summary.proto` that scalars need.
#[derive(Clone, PartialEq, Message)]
struct Event {
    #[prost(double, tag = "1")]
    wall_time: f64,
    #[prost(int64, tag = "2")]
    step: i64,
    #[prost(oneof = "What", tags = "3, 5, 7")]
    what: Option<What>,
}

#[derive(Clone, PartialEq, prost::Oneof)]
enum What {
    #[prost(string, tag = "3")]
    FileVersion(String),
    #[prost(message, tag = "5")]
    Summary(Summary),
    #[prost(message, tag = "7")]
    SessionLog(SessionLog),
}

#[derive(Clone, PartialEq, Message)]
struct Summary {
    #[prost(message, repeated, tag = "1")]
    value: Vec<Value>,
}

#[derive(Clone, PartialEq, Message)]
struct Value {
    #[prost(string, tag = "1")]
    tag: String,
    /// Part of a oneof: a zero that is left out would be no value.
    #[prost(float, optional, tag = "2")]
    simple_value: Option<f32>,
}

#[derive(Clone, PartialEq, Message)]
struct SessionLog {
    #[prost(enumeration = "SessionStatus", tag = "1")]
    status: i32,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash, prost::Enumeration)]
#[repr(i32)]
enum SessionStatus {
    Unspecified = 0,
    Start = 1,
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{checkpoint::Progress, evaluation::Exploring, measured::Measured};

    /// The events of a file, both checksums of each verified.
    fn read(bytes: &[u8]) -> Vec<Event> {
        let (mut rest, mut events) = (bytes, Vec::new());
        while !rest.is_empty() {
            let (len_bytes, after) = rest.split_at(8);
            let len = u64::from_le_bytes(len_bytes.try_into().unwrap()) as usize;
            let (len_crc, after) = after.split_at(4);
            let (data, after) = after.split_at(len);
            let (data_crc, after) = after.split_at(4);
            assert_eq!((len_crc, data_crc), (&masked_crc(len_bytes)[..], &masked_crc(data)[..]));
            events.push(Event::decode(data).unwrap());
            rest = after;
        }
        events
    }

    /// The events of all files of a folder, in order of their names.
    fn read_all(folder: &Path) -> Vec<Vec<Event>> {
        let mut files: Vec<_> = fs::read_dir(folder).unwrap().map(|entry| entry.unwrap().path()).collect();
        files.sort();
        files.iter().map(|file| read(&fs::read(file).unwrap())).collect()
    }

    /// (step, tag, value) of every scalar.
    fn scalars(events: &[Event]) -> Vec<(i64, String, f32)> {
        let mut scalars = Vec::new();
        for event in events {
            if let Some(What::Summary(summary)) = &event.what {
                let of = |value: &Value| (event.step, value.tag.clone(), value.simple_value.unwrap());
                scalars.extend(summary.value.iter().map(of));
            }
        }
        scalars
    }

    fn progress(env_steps: u64) -> Progress {
        Progress { env_steps, episodes: 40, updates: 7 }
    }

    fn evaluation(env_steps: u64) -> Line {
        let result = TaskResult {
            task: String::new(),
            episodes: 32,
            mean_return: -2.5,
            win_rate: Some(0.75),
            exploring: None,
        };
        let tasks = BTreeMap::from([("game-1".to_owned(), result)]);
        Line::Evaluation { progress: progress(env_steps), wall_s: 1.0, tasks }
    }

    #[test]
    fn checksums_are_those_of_the_format() {
        // RFC 3720, B.4: 32 bytes of zeros.
        assert_eq!(CRC.checksum(&[0; 32]), 0x8a91_36aa);
        // 0x8a9136aa rotated right by 15 is 0x6d55_1522; plus 0xa282ead8.
        assert_eq!(u32::from_le_bytes(masked_crc(&[0; 32])), 0x0fd7_fffa);
    }

    #[test]
    fn lines_become_scalars_over_environment_steps() {
        let folder = tempfile::tempdir().unwrap();
        let folder = folder.path().join("tensorboard");
        let mut events = EventFile::create(&folder, &Position::default(), 0).unwrap();
        events.write(&evaluation(0));
        let measured = [("td_loss", 0.5), ("grad_norm", 3.0), ("q_total_mean", 0.0), ("target_mean", -1.5)];
        let measured = Measured(measured.map(|(name, value)| (name.to_owned(), value)).to_vec());
        let exploring = Some(Exploring { episodes_total: 9, policy_lag: 1 });
        let result =
            TaskResult { task: String::new(), episodes: 9, mean_return: 4.5, win_rate: None, exploring };
        let tasks = BTreeMap::from([("3v3".to_owned(), result)]);
        let line = Line::Training { progress: progress(100), wall_s: 2.0, epsilon: 0.125, measured, tasks };
        events.write(&line);
        let files = read_all(&folder);
        assert_eq!(files.len(), 1);
        assert_eq!(files[0][0].what, Some(What::FileVersion("brain.Event:2".into())));
        assert!(files[0].iter().all(|event| event.wall_time > 1.7e9));
        let expected = [
            (0, "greedy_return/game-1", -2.5),
            (0, "greedy_win_rate/game-1", 0.75),
            (100, "training/td_loss", 0.5),
            (100, "training/grad_norm", 3.0),
            (100, "training/q_total_mean", 0.0),
            (100, "training/target_mean", -1.5),
            (100, "training/epsilon", 0.125),
            (100, "training/episodes", 40.0),
            (100, "training/updates", 7.0),
            (100, "exploring_return/3v3", 4.5),
            (100, "policy_lag/3v3", 1.0),
            (100, "episodes/3v3", 9.0),
        ];
        let expected = expected.map(|(step, tag, number)| (step, tag.to_owned(), number));
        assert_eq!(scalars(&files[0]), expected);
    }

    #[test]
    fn no_step_is_there_twice_after_resuming() {
        let folder = tempfile::tempdir().unwrap();
        let mut first = EventFile::create(folder.path(), &Position::default(), 0).unwrap();
        first.write(&evaluation(10));
        let at_checkpoint = first.position().clone();
        first.write(&evaluation(20));
        // A learner that goes on from there, and dies before its first checkpoint.
        let mut second = EventFile::create(folder.path(), &at_checkpoint, 11).unwrap();
        second.write(&evaluation(20));
        let mut third = EventFile::create(folder.path(), &at_checkpoint, 11).unwrap();
        third.write(&evaluation(20));
        assert!(third.position().file > second.position().file, "a name that was never used");
        let files = read_all(folder.path());
        let steps: Vec<Vec<i64>> =
            files.iter().map(|events| events.iter().map(|event| event.step).collect()).collect();
        assert_eq!(steps, [vec![0, 0, 10], vec![0, 11, 20]]);
        let start = SessionLog { status: SessionStatus::Start.into() };
        assert_eq!(files[1][1].what, Some(What::SessionLog(start)));
        // One that begins anew keeps nothing.
        EventFile::create(folder.path(), &Position::default(), 0).unwrap();
        assert_eq!(read_all(folder.path()).len(), 1);
    }
}
