//! What a case's files hold, and which of its padded cells are real.

use rit_episode::{End, Episode, decision_order};
use rit_nn::Param;
use safetensors::{Dtype, SafeTensors};
use serde::de::DeserializeOwned;
use std::{
    fs,
    path::{Path, PathBuf},
};

/// Every folder with a `case.json`, at any depth, the root included.
pub fn cases_under(root: &Path) -> Vec<PathBuf> {
    let entries = fs::read_dir(root).unwrap_or_else(|error| panic!("{}: {error}", root.display()));
    let mut folders: Vec<_> = entries.map(|entry| entry.unwrap().path()).collect();
    folders.retain(|path| path.is_dir());
    folders.sort();
    let itself = root.join("case.json").is_file().then(|| root.to_owned());
    itself.into_iter().chain(folders.iter().flat_map(|folder| cases_under(folder))).collect()
}

/// A case's `case.json`.
pub fn described<T: DeserializeOwned>(folder: &Path) -> T {
    let path = folder.join("case.json");
    let bytes = fs::read(&path).unwrap_or_else(|error| panic!("{}: {error}", path.display()));
    serde_json::from_slice(&bytes).unwrap_or_else(|error| panic!("{}: {error}", path.display()))
}

/// A safetensors file.
pub struct Tensors {
    path: PathBuf,
    bytes: Vec<u8>,
}

impl Tensors {
    pub fn read(folder: &Path, name: &str) -> Self {
        let path = folder.join(name).with_extension("safetensors");
        let bytes = fs::read(&path).unwrap_or_else(|error| panic!("{}: {error}", path.display()));
        Self { path, bytes }
    }

    /// A file that a case may lack.
    pub fn read_if_there(folder: &Path, name: &str) -> Option<Self> {
        let is_there = folder.join(name).with_extension("safetensors").exists();
        is_there.then(|| Self::read(folder, name))
    }

    fn all(&self) -> SafeTensors<'_> {
        let all = SafeTensors::deserialize(&self.bytes);
        all.unwrap_or_else(|error| panic!("{}: {error}", self.path.display()))
    }

    pub fn holds(&self, name: &str) -> bool {
        self.all().tensor(name).is_ok()
    }

    /// Every tensor's name and shape.
    pub fn shapes(&self) -> Vec<(String, Vec<usize>)> {
        let shapes = self.all().tensors().into_iter();
        shapes.map(|(name, tensor)| (name, tensor.shape().to_vec())).collect()
    }

    /// A tensor's numbers, whichever way they are stored.
    fn numbers(&self, name: &str) -> Vec<f64> {
        let path = self.path.display();
        let all = self.all();
        let tensor = all.tensor(name).unwrap_or_else(|error| panic!("{path}: {name}: {error}"));
        let data = tensor.data();
        let (fours, eights) = (data.as_chunks::<4>().0.iter(), data.as_chunks::<8>().0.iter());
        match tensor.dtype() {
            Dtype::F32 => fours.map(|&word| f64::from(f32::from_le_bytes(word))).collect(),
            Dtype::F64 => eights.map(|&word| f64::from_le_bytes(word)).collect(),
            Dtype::I32 => fours.map(|&word| f64::from(i32::from_le_bytes(word))).collect(),
            Dtype::I64 => eights.map(|&word| i64::from_le_bytes(word) as f64).collect(),
            Dtype::U8 | Dtype::BOOL => data.iter().map(|&byte| f64::from(byte)).collect(),
            other => panic!("{path}: {name} holds {other:?}, which is not read here"),
        }
    }

    pub fn f32(&self, name: &str) -> Vec<f32> {
        self.numbers(name).into_iter().map(|number| number as f32).collect()
    }

    pub fn i32(&self, name: &str) -> Vec<i32> {
        self.numbers(name).into_iter().map(|number| number as i32).collect()
    }

    /// These parameters by name, one after another; where the file lacks one, `instead`, if that may be.
    pub fn params(&self, params: &[Param], instead: Option<f32>) -> Vec<f32> {
        let mut flat = Vec::new();
        for param in params {
            match instead {
                Some(value) if !self.holds(&param.name) => flat.resize(param.range.end, value),
                _ => flat.extend(self.f32(&param.name)),
            }
            let (path, name) = (self.path.display(), &param.name);
            assert_eq!(flat.len(), param.range.end, "{path}: {name} is not {:?}", param.shape);
        }
        flat
    }
}

/// Sizes of a padded batch.
#[derive(Clone, Copy)]
pub struct Padding {
    pub entity_dim: usize,
    pub n_actions: usize,
    pub agents_max: usize,
    pub entities_max: usize,
}

/// Which cells of the padded batch are real.
pub struct Cells {
    pub padding: Padding,
    pub steps_max: usize,
    /// Filled steps of each episode.
    pub steps: Vec<usize>,
    /// Rows of real agents and of all real entities, by episode.
    pub agents: Vec<Vec<usize>>,
    pub entities: Vec<Vec<usize>>,
}

impl Cells {
    pub fn read(batch: &Tensors, padding: Padding) -> Self {
        let (filled, present) = (batch.f32("filled"), batch.f32("present"));
        let episodes = present.len() / padding.entities_max;
        let steps_max = filled.len() / episodes;
        let steps = filled.chunks(steps_max).map(|filled| {
            let steps = filled.iter().filter(|&&filled| filled == 1.0).count();
            assert!(filled[..steps].iter().all(|&filled| filled == 1.0), "filled steps come first");
            assert!(steps > 0, "every episode has a step");
            steps
        });
        let real = |present: &[f32], rows: usize| (0..rows).filter(|&row| present[row] == 1.0).collect();
        let present = || present.chunks(padding.entities_max);
        Self {
            padding,
            steps_max,
            steps: steps.collect(),
            agents: present().map(|present| real(present, padding.agents_max)).collect(),
            entities: present().map(|present| real(present, padding.entities_max)).collect(),
        }
    }

    pub fn episodes(&self) -> usize {
        self.steps.len()
    }

    /// The real rows of one episode.
    pub fn episode(&self, batch: &Tensors, index: usize) -> Episode {
        let Padding { entity_dim: d, n_actions: a, agents_max: n_max, entities_max: m_max } = self.padding;
        let (agents, others, steps) = (&self.agents[index], &self.entities[index], self.steps[index]);
        let state = |time: usize| index * (self.steps_max + 1) + time;
        let (entities, observable, available) =
            (batch.f32("entities"), batch.f32("observable"), batch.f32("available"));
        let (actions, rewards, terminated) =
            (batch.i32("actions"), batch.f32("rewards"), batch.f32("terminated"));
        let mut episode = Episode {
            number: index as u64,
            weights_version: 0,
            task: batch.i32("task")[index] as usize,
            n_agents: agents.len(),
            n_entities: others.len(),
            decision_order: decision_order::identity(agents.len()),
            entities: vec![],
            observable: vec![],
            available: vec![],
            actions: vec![],
            rewards: rewards[index * self.steps_max..][..steps].to_vec(),
            shaping: vec![0.0; steps],
            end: if terminated[index * self.steps_max + steps - 1] == 1.0 {
                End::Terminated
            } else {
                End::Truncated
            },
            won: false,
        };
        for time in 0..=steps {
            for &row in others {
                episode.entities.extend_from_slice(&entities[(state(time) * m_max + row) * d..][..d]);
            }
            for &agent in agents {
                let row = &observable[(state(time) * n_max + agent) * m_max..][..m_max];
                episode.observable.extend(others.iter().map(|&entity| row[entity] as u8));
                let row = &available[(state(time) * n_max + agent) * a..][..a];
                episode.available.extend(row.iter().map(|&flag| flag as u8));
            }
            if time < steps {
                let row = &actions[(index * self.steps_max + time) * n_max..][..n_max];
                episode.actions.extend(agents.iter().map(|&agent| row[agent] as u8));
            }
        }
        episode
    }
}
