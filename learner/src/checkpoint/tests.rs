use super::*;
use crate::{evaluation::Exploring, ledger::Terms, tensorboard::Position};
use rit_episode::{
    RunSeed, Stream,
    wire::{PayloadLayout, TaskSize},
};
use std::sync::Arc;

struct Run {
    _folder: tempfile::TempDir,
    run_dir: RunDir,
    learner: Box<dyn Learner>,
    config: Config,
}

fn run() -> Run {
    let mut config = rit_config::resolve("environment.task_set = \"matrix-game\"", "test", &[]).unwrap();
    let folder = tempfile::tempdir().unwrap();
    let run_dir = RunDir::create(&folder.path().join("run"), &config).unwrap();
    config.algorithm.buffer_size = 0;
    let model = Arc::new(Model::new(config.model()).unwrap());
    let params = model.initial(&mut RunSeed(1).stream(Stream::Weights, 0));
    let learner = rit_algo::learner(model, config.update(), params).unwrap();
    Run { _folder: folder, run_dir, learner, config }
}

impl Run {
    /// A state whose numbers tell which it is. Its run has a replay of no episodes.
    fn state(&self, env_steps: u64) -> TrainingState {
        let numbers = |len: usize, index: u64| -> Vec<f32> {
            let layout = self.learner.model().initial(&mut RunSeed(env_steps).stream(Stream::Weights, index));
            layout.into_iter().cycle().take(len).collect()
        };
        let params = numbers(self.learner.params().len(), 0);
        let acting = numbers(self.learner.model().acting().len(), 1);
        let learner =
            self.learner.state().into_iter().enumerate().map(|(index, NamedState { name, numbers: its })| {
                let numbers = match its {
                    Numbers::F32(its) => Numbers::F32(numbers(its.len(), 2 + index as u64).into()),
                    Numbers::F64(its) => Numbers::F64(vec![0.1 + 0.2; its.len()].into()),
                    Numbers::U64(its) => Numbers::U64(vec![env_steps; its.len()].into()),
                };
                NamedState { name, numbers }
            });
        TrainingState {
            learner: learner.collect(),
            snapshots: vec![Snapshot::new(4, 90, &acting), Snapshot::new(5, 100, &acting)],
            manifest: Manifest {
                progress: Progress { env_steps, episodes: 10, updates: 5 },
                target_copied_at: 3,
                terms: [4, 5].map(|weights_version| Terms { weights_version, epsilon: 0.1 + 0.2 }).to_vec(),
                snapshots: [(4, 90), (5, 100)]
                    .map(|(version, env_steps)| SnapshotMark { version, env_steps })
                    .to_vec(),
                recent: vec![vec![(0.1 + 0.2, true)], vec![]],
                exploring: vec![Exploring { episodes_total: 9, policy_lag: 1 }],
                metrics_len: 77,
                tensorboard: Position { file: "events".into(), len: 55 },
                wall_s: 1.5,
                evaluation: None,
                weights_digest: weights_file::digest(&params),
            },
            params,
        }
    }

    fn save(&self, env_steps: u64) -> PathBuf {
        self.run_dir
            .root()
            .join(save(&self.run_dir, self.learner.model(), &self.state(env_steps), 3).unwrap())
    }

    fn load(&self) -> Result<Option<Loaded>, CheckpointError> {
        let dims = rit_env::TaskSet::MatrixGame.dims();
        let layout = PayloadLayout::new(dims);
        let tasks = vec![TaskSize { n_agents: 2, n_entities: 2 }; 2];
        let expected = Expected { run_id: self.run_dir.run_id(), layout, tasks };
        load_newest(&self.run_dir, &*self.learner, &expected, &self.config)
    }
}

#[test]
fn a_state_comes_back_whole_and_latest_is_the_newest() {
    let run = run();
    assert!(run.load().unwrap().is_none(), "none was ever written");
    run.save(50);
    run.save(100);
    let loaded = run.load().unwrap().unwrap();
    assert_eq!(loaded.state, run.state(100));
    assert!(loaded.damaged.is_empty());
    let latest = run.run_dir.checkpoints().join(LATEST);
    assert_eq!(load(&latest, &*run.learner, 2, &run.config.algorithm).unwrap(), run.state(100));
    run.save(100);
    assert_eq!(run.load().unwrap().unwrap().state, run.state(100), "once more by request");
}

#[test]
fn only_the_last_few_are_kept() {
    let run = run();
    for env_steps in [10, 20, 30, 40, 50] {
        run.save(env_steps);
    }
    let kept = folders(&run.run_dir.checkpoints()).unwrap();
    let names: Vec<_> = kept.iter().map(|path| path.file_name().unwrap().to_str().unwrap()).collect();
    assert_eq!(names, ["step-000000000030", "step-000000000040", "step-000000000050"]);
}

#[test]
fn a_damaged_newest_is_reported_and_the_one_before_is_used() {
    for name in [WEIGHTS, STATE, MANIFEST, SUMS] {
        let run = run();
        run.save(10);
        let newest = run.save(20);
        let path = newest.join(name);
        let mut bytes = fs::read(&path).unwrap();
        let middle = bytes.len() / 2;
        bytes[middle] ^= 1;
        fs::write(&path, bytes).unwrap();
        let loaded = run.load().unwrap().unwrap();
        assert_eq!(loaded.state, run.state(10), "{name}");
        assert!(loaded.damaged[0].to_string().contains("was altered"), "{name}: {}", loaded.damaged[0]);
        fs::remove_file(&path).unwrap();
        assert!(run.load().unwrap().unwrap().damaged[0].to_string().contains("No such file"), "{name}");
    }
}

#[test]
fn a_manifest_that_was_rewritten_with_its_sum_is_refused_for_what_it_says() {
    let run = run();
    run.save(10);
    let newest = run.save(20);
    let read = |name: &str| fs::read_to_string(newest.join(name)).unwrap();
    let (manifest, sums) = (read(MANIFEST), read(SUMS));
    let rewritten = manifest.replace("\"updates\": 5", "\"updates\": 11");
    let sum = |text: &str| sha256(text.as_bytes());
    fs::write(newest.join(MANIFEST), &rewritten).unwrap();
    fs::write(newest.join(SUMS), sums.replace(&sum(&manifest), &sum(&rewritten))).unwrap();
    let loaded = run.load().unwrap().unwrap();
    assert_eq!(loaded.state, run.state(10));
    let message = loaded.damaged[0].to_string();
    assert!(message.ends_with("checkpoint.json: 11 updates are more than 10 batches"), "{message}");
}

#[test]
fn what_was_half_written_is_nothing() {
    let run = run();
    run.save(10);
    let partial = run.run_dir.checkpoints().join("step-000000000020.partial");
    fs::create_dir(&partial).unwrap();
    fs::write(partial.join(WEIGHTS), "half").unwrap();
    let loaded = run.load().unwrap().unwrap();
    assert_eq!((loaded.state, loaded.damaged.len()), (run.state(10), 0));
    run.save(20);
    assert_eq!(run.load().unwrap().unwrap().state, run.state(20));
}

#[test]
fn never_a_silent_fresh_start() {
    let run = run();
    for folder in [run.save(10), run.save(20)] {
        fs::write(folder.join(SUMS), "").unwrap();
    }
    let message = run.load().unwrap_err().to_string();
    assert!(message.contains("no checkpoint in") && message.contains("step-000000000020"), "{message}");
}
