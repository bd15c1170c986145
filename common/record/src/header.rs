//! The first line of `metrics.jsonl`: whose file it is, and how the run was made.

use crate::{Build, Host};
use rit_algo::learner::Measure;
use rit_config::{Config, ConfigError, RunDir};
use serde::{Deserialize, Serialize};
use std::{collections::BTreeMap, io};

/// What the lines of this build look like. Raise it when a key's meaning changes.
pub(crate) const FORMAT_VERSION: u32 = 1;

/// How the first line begins.
const BEGINNING: &[u8] = br#"{"kind":"run","#;

/// Whether a line is a header.
pub fn is_header(line: &[u8]) -> bool {
    line.starts_with(BEGINNING)
}

/// The first line. The kind comes first, so that a reader of lines can tell.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Header {
    kind: String,
    /// See [`Header::check`].
    pub format_version: u32,
    /// The run, in hexadecimal; of a copied run the first one.
    pub run_id: String,
    /// How the run was made; older builds did not say so.
    #[serde(flatten)]
    pub run: Option<Run>,
}

/// How a run was made.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct Run {
    /// Every key of the configuration with its value, as the run began.
    pub settings: BTreeMap<String, String>,
    /// The program that the run began with.
    pub build: Build,
    /// Where it began.
    pub host: Host,
    /// Numbers that are trained.
    pub parameters: u64,
    /// What updates report.
    pub measures: Vec<MeasureHelp>,
}

/// A number that updates report.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct MeasureHelp {
    /// As it stands in lines.
    pub name: String,
    /// What it is, in a few words.
    pub help: String,
}

/// Why a learner cannot go on with a file.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
pub enum OtherFile {
    /// Another run's.
    #[error(
        "it is of another run ({found}); move it away, and the lines up to the checkpoint are missed, nothing else"
    )]
    Run {
        /// That run.
        found: String,
    },
    /// Another build's.
    #[error(
        "it has format version {found}, this build writes {FORMAT_VERSION}; go on with the build that wrote it"
    )]
    Format {
        /// Its version.
        found: u32,
    },
}

impl Run {
    /// Of a run with this configuration that begins here and now.
    ///
    /// # Errors
    /// When the configuration cannot be written down.
    pub fn begins(
        config: &Config,
        build: Build,
        parameters: usize,
        measures: &[Measure],
    ) -> Result<Self, ConfigError> {
        let help = |measure: &Measure| MeasureHelp { name: measure.name.into(), help: measure.help.into() };
        Ok(Self {
            settings: config.settings()?,
            build,
            host: Host::this(),
            parameters: parameters as u64,
            measures: measures.iter().map(help).collect(),
        })
    }
}

impl Header {
    /// Of this run's file.
    pub fn new(run_dir: &RunDir, run: Run) -> Self {
        let run_id = run_dir.lineage().iter().map(|byte| format!("{byte:02x}")).collect();
        Self::of(run_id, Some(run))
    }

    /// Of the file of a run with this identity.
    pub fn of(run_id: String, run: Option<Run>) -> Self {
        Self { kind: "run".into(), format_version: FORMAT_VERSION, run_id, run }
    }

    /// The line itself.
    ///
    /// # Errors
    /// When it is no JSON, which no header is.
    pub fn line(&self) -> io::Result<Vec<u8>> {
        let mut line = serde_json::to_vec(self)?;
        line.push(b'\n');
        Ok(line)
    }

    /// Whether a learner with this header may go on with a file that begins with the `other`.
    ///
    /// # Errors
    /// When it is of another run or of another format.
    pub fn check(&self, other: &Self) -> Result<(), OtherFile> {
        if other.format_version != self.format_version {
            return Err(OtherFile::Format { found: other.format_version });
        }
        if other.run_id != self.run_id {
            return Err(OtherFile::Run { found: other.run_id.clone() });
        }
        Ok(())
    }
}
