//! What is measured while training: `metrics.jsonl`, one object a line, its readers, and how episodes went
//! of late.

use crate::{
    append_file::AppendFile,
    metrics_repair::{End, MetricsError, repair},
};
use rit_config::open_regular;
use rit_episode::Episode;
use rit_record::{Exploring, Header, Line, TaskResult, is_header};
use std::{
    collections::VecDeque,
    fs::OpenOptions,
    io::{self, Read, Seek as _, SeekFrom},
    path::{Path, PathBuf},
    time::Instant,
};
use tokio::sync::watch;

/// Episodes of each task that count as of late.
pub const RECENT: usize = 100;

/// Bytes that a follower of the file reads at a time: far more than most lines have.
const CHUNK: u64 = 1 << 20;

/// The longest line that a follower reads: one of an evaluation of very many episodes is longer than a chunk.
const LINE_BYTES_MAX: u64 = 1 << 28;

/// How exploring episodes of each training task went of late.
#[derive(Debug)]
pub struct Recent {
    tasks: Vec<String>,
    has_wins: bool,
    /// (return, won), the newest last, by task.
    episodes: Vec<VecDeque<(f64, bool)>>,
    exploring: Vec<Exploring>,
}

impl Recent {
    /// Of tasks with these names, which know winning or not.
    pub fn new(tasks: Vec<String>, has_wins: bool) -> Self {
        let episodes = tasks.iter().map(|_| VecDeque::with_capacity(RECENT)).collect();
        let exploring = vec![Exploring::default(); tasks.len()];
        Self { tasks, has_wins, episodes, exploring }
    }

    /// What is counted: (return, won), the newest last, by task.
    pub fn windows(&self) -> Vec<Vec<(f64, bool)>> {
        self.episodes.iter().map(|recent| recent.iter().copied().collect()).collect()
    }

    /// How each task goes on the whole.
    pub fn exploring(&self) -> &[Exploring] {
        &self.exploring
    }

    /// Goes on with what was counted before.
    pub fn restore(&mut self, windows: Vec<Vec<(f64, bool)>>, exploring: Vec<Exploring>) {
        for (recent, window) in self.episodes.iter_mut().zip(windows) {
            *recent = window.into();
        }
        for (now, before) in self.exploring.iter_mut().zip(exploring) {
            *now = before;
        }
    }

    /// Counts an episode that enters replay after so many updates.
    pub fn push(&mut self, episode: &Episode, updates: u64) {
        let Some(recent) = self.episodes.get_mut(episode.task) else { return };
        if recent.len() == RECENT {
            recent.pop_front();
        }
        recent.push_back((episode.total_reward(), episode.won));
        let exploring = &mut self.exploring[episode.task];
        exploring.episodes_total += 1;
        exploring.policy_lag = updates.saturating_sub(episode.weights_version);
    }

    /// Means by task, of those that had an episode.
    pub fn results(&self) -> Vec<TaskResult> {
        let tasks = self.tasks.iter().zip(&self.episodes).zip(&self.exploring);
        tasks
            .filter(|((_, recent), _)| !recent.is_empty())
            .map(|((task, recent), exploring)| {
                let count = recent.len() as f64;
                let won = recent.iter().filter(|(_, won)| *won).count() as f64;
                TaskResult {
                    task: task.clone(),
                    episodes: recent.len() as u64,
                    mean_return: recent.iter().map(|(total, _)| total).sum::<f64>() / count,
                    win_rate: self.has_wins.then_some(won / count),
                    each: None,
                    exploring: Some(*exploring),
                }
            })
            .collect()
    }
}

/// Writes `metrics.jsonl`.
#[derive(Debug)]
pub struct MetricsFile {
    path: PathBuf,
    file: AppendFile,
    /// Bytes written, as followers of the file know them.
    len: watch::Sender<u64>,
    started: Instant,
    /// Seconds that learners before this one ran.
    before_s: f64,
}

impl MetricsFile {
    /// Begins the file, or goes on after the `end` that a checkpoint remembers: what comes after it was written by a
    /// learner that died, and will be written again. `before_s` are the seconds that learners ran before. Also returns a
    /// warning if it had to be repaired.
    ///
    /// # Errors
    /// When it is of another run or build, or cannot be written.
    pub fn open(
        path: &Path,
        header: &Header,
        end: Option<End>,
        before_s: f64,
    ) -> Result<(Self, Option<String>), MetricsError> {
        let (len, warning) = end.map_or(Ok((0, None)), |end| repair(path, header, end))?;
        let mut options = OpenOptions::new();
        let file = open_regular(path, options.create(true).truncate(false).write(true))?;
        let mut file = AppendFile::new(path.to_owned(), file, len)?;
        if len == 0 {
            file.append(&header.line()?);
        }
        let len = watch::Sender::new(file.written());
        Ok((Self { path: path.to_owned(), file, len, started: Instant::now(), before_s }, warning))
    }

    /// Seconds that learners have run, this one and those before.
    pub fn wall_s(&self) -> f64 {
        self.before_s + self.started.elapsed().as_secs_f64()
    }

    /// Bytes written.
    pub fn len(&self) -> u64 {
        *self.len.borrow()
    }

    /// Whether nothing is written yet.
    pub fn is_empty(&self) -> bool {
        self.len() == 0
    }

    /// A reader of all its lines, from the first.
    pub fn follower(&self) -> Follower {
        Follower { path: self.path.clone(), at: 0, len: self.len.subscribe() }
    }

    /// Writes a line, or keeps it until the disk takes it.
    ///
    /// # Errors
    /// When the line is no JSON, which none is.
    pub fn write(&mut self, line: &Line) -> io::Result<()> {
        let mut text = serde_json::to_vec(line)?;
        text.push(b'\n');
        self.file.append(&text);
        self.len.send_replace(self.file.written());
        Ok(())
    }

    /// Writes what the disk has refused so far.
    ///
    /// # Errors
    /// When it refuses again.
    pub fn flush(&mut self) -> io::Result<()> {
        self.file.flush()?;
        self.len.send_replace(self.file.written());
        Ok(())
    }
}

/// Reads `metrics.jsonl` while it is written. However slow it is, it holds up no other and misses nothing: what it
/// has not read lies in the file.
#[derive(Clone, Debug)]
pub struct Follower {
    path: PathBuf,
    /// Where it reads on, in bytes.
    at: u64,
    len: watch::Receiver<u64>,
}

impl Follower {
    /// The next lines, some of those there are; none when it has read them all.
    ///
    /// # Errors
    /// When the file cannot be read or holds something else.
    pub fn read(&mut self) -> io::Result<Vec<Line>> {
        let len = *self.len.borrow_and_update();
        let mut file = open_regular(&self.path, OpenOptions::new().read(true))?;
        file.seek(SeekFrom::Start(self.at))?;
        let (text, whole) = read_lines(&mut file.take(len.saturating_sub(self.at)), LINE_BYTES_MAX)?;
        self.at += whole as u64;
        let lines =
            text[..whole].split(|&byte| byte == b'\n').filter(|line| !line.is_empty() && !is_header(line));
        lines.map(|line| Line::parse(line).map_err(io::Error::from)).collect()
    }

    /// Where it reads on, in bytes.
    pub fn at(&self) -> u64 {
        self.at
    }

    /// Reads on from here, which is where a line begins.
    pub fn begin_at(&mut self, at: u64) {
        self.at = at;
    }

    /// Waits for further lines; `false` when there will be none, since the writer has gone.
    pub async fn more(&mut self) -> bool {
        self.len.changed().await.is_ok()
    }
}

/// The next chunk, or as many as it takes to come to the end of a line; and how many bytes of it are whole lines.
fn read_lines(file: &mut impl Read, line_bytes_max: u64) -> io::Result<(Vec<u8>, usize)> {
    let mut text = Vec::new();
    loop {
        let before = text.len();
        file.by_ref().take(CHUNK).read_to_end(&mut text)?;
        if let Some(at) = text[before..].iter().rposition(|&byte| byte == b'\n') {
            return Ok((text, before + at + 1));
        }
        if text.len() == before {
            return Ok((text, 0));
        }
        if text.len() as u64 > line_bytes_max {
            let words = format!(
                "a line has more than {line_bytes_max} bytes; set evaluation.episodes lower, so that lines are shorter"
            );
            return Err(io::Error::new(io::ErrorKind::FileTooLarge, words));
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::messages::line_of_test as line;
    use std::fs;

    fn open(path: &Path, end: Option<End>, before_s: f64) -> MetricsFile {
        let header = Header::of("ab".into(), None);
        let (file, warning) = MetricsFile::open(path, &header, end, before_s).unwrap();
        assert_eq!(warning, None);
        file
    }

    #[test]
    fn a_resumed_file_forgets_what_the_dead_learner_wrote_last() {
        let file = tempfile::NamedTempFile::new().unwrap();
        let mut first = open(file.path(), None, 0.0);
        first.write(&line(1)).unwrap();
        let at_checkpoint = End { env_steps: 1, len: first.len() };
        first.write(&line(2)).unwrap();
        let mut second = open(file.path(), Some(at_checkpoint), 100.0);
        second.write(&line(3)).unwrap();
        assert!(second.wall_s() >= 100.0);
        let lines = second.follower().read().unwrap();
        assert_eq!(lines, [line(1), line(3)]);
        assert_eq!(second.len(), fs::metadata(file.path()).unwrap().len());
        let text = fs::read_to_string(file.path()).unwrap();
        assert_eq!(text.lines().next(), Some(r#"{"kind":"run","format_version":1,"run_id":"ab"}"#));
        // One that begins anew keeps nothing.
        assert!(open(file.path(), None, 0.0).follower().read().unwrap().is_empty());
    }

    #[tokio::test]
    async fn a_follower_reads_every_line_once_and_sees_the_end() {
        let file = tempfile::NamedTempFile::new().unwrap();
        let mut metrics = open(file.path(), None, 0.0);
        // More than is read at a time.
        let many = 5000;
        for env_steps in 0..many {
            metrics.write(&line(env_steps)).unwrap();
        }
        assert!(metrics.len() > CHUNK);
        let mut follower = metrics.follower();
        let mut read = Vec::new();
        let mut read_all = |follower: &mut Follower| {
            loop {
                let lines = follower.read().unwrap();
                if lines.is_empty() {
                    return read.len();
                }
                read.extend(lines.iter().map(|line| line.progress().unwrap().env_steps));
            }
        };
        assert_eq!(read_all(&mut follower), many as usize);
        metrics.write(&line(many)).unwrap();
        assert!(follower.more().await);
        assert_eq!(read_all(&mut follower), many as usize + 1);
        drop(metrics);
        assert!(!follower.more().await);
        assert!(read.into_iter().eq(0..=many));
    }

    #[test]
    fn a_line_longer_than_what_is_read_at_a_time_holds_up_no_reader() {
        let file = tempfile::NamedTempFile::new().unwrap();
        let mut metrics = open(file.path(), None, 0.0);
        let mut long = line(2);
        let Line::Training(point) = &mut long else { panic!("{long:?}") };
        point.tasks.insert("x".repeat(3 * CHUNK as usize), TaskResult::default());
        for written in [&line(1), &long, &line(3)] {
            metrics.write(written).unwrap();
        }
        let mut follower = metrics.follower();
        let mut read = Vec::new();
        while follower.at() < metrics.len() {
            let lines = follower.read().unwrap();
            assert!(!lines.is_empty(), "it stays at {}", follower.at());
            read.extend(lines.iter().map(|line| line.progress().unwrap().env_steps));
        }
        assert_eq!(read, [1, 2, 3]);
    }

    #[test]
    fn a_line_that_never_ends_is_refused() {
        let endless = read_lines(&mut io::repeat(b'x'), 2 * CHUNK).unwrap_err();
        assert!(endless.to_string().contains("a line has more than 2097152 bytes"), "{endless}");
        let whole = |text: &[u8]| read_lines(&mut &text[..], 2 * CHUNK).unwrap();
        assert_eq!(whole(b"{}\n{\"half"), (b"{}\n{\"half".to_vec(), 3));
        assert_eq!(whole(b"{\"half"), (b"{\"half".to_vec(), 0));
    }
}
