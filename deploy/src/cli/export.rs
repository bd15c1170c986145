//! Options of the command that writes what others can load.

use super::{PlayOptions, values::within};
use clap::Args;
use rit_config::count;
use std::path::PathBuf;

/// What comes out, and where the pages on it are.
const FORMATS: &str = "\
--onnx writes encoder.onnx and head.onnx, weights inside, which any ONNX runtime acts with.
--episodes writes one safetensors file, which NumPy and PyTorch load as it is, and of which the Python package makes Minari
datasets (rit.episodes.to_minari). Episodes are those that `rit evaluate` measures with the same seed.
The page deploy/docs/export.md describes both.";

#[derive(Args, Debug)]
#[command(after_help = FORMATS)]
#[group(id = "what", required = true, args = ["onnx", "episodes"])]
pub struct ExportOptions {
    #[command(flatten)]
    pub play: PlayOptions,
    /// Write the run's policy as ONNX graphs into this folder
    #[arg(long, value_name = "DIR", conflicts_with_all = ["policy", "experiment", "backend"])]
    pub onnx: Option<PathBuf>,
    /// Roll so many episodes of each task, and write them to --out
    #[arg(long, value_name = "N", requires = "out", value_parser = within::<u32>(1, 1_000_000))]
    pub episodes: Option<u32>,
    /// File for episodes, ending in .safetensors
    #[arg(long, value_name = "FILE", conflicts_with = "onnx")]
    pub out: Option<PathBuf>,
    /// Tasks of the episodes: training, testing, or names
    #[arg(long, value_delimiter = ',', default_value = "training", conflicts_with = "onnx")]
    pub tasks: Vec<String>,
    /// Seed of the episodes; without it one that follows from the run's
    #[arg(long, allow_negative_numbers = true, value_parser = count, conflicts_with = "onnx")]
    pub seed: Option<u64>,
    /// Write over files that are there
    #[arg(long)]
    pub force: bool,
    /// Print JSON
    #[arg(long)]
    pub json: bool,
}
