//! The comparison itself: which cases it finds and can read, and that it sees what differs.

use super::{cases_under, differences};
use safetensors::{Dtype, SafeTensors, tensor::TensorView};
use serde_json::Value;
use std::{
    collections::BTreeMap,
    fs,
    path::{Path, PathBuf},
};

/// A case of each kind of losses and inputs.
const CASES: [&str; 6] =
    ["mappo-small", "mat-small", "qmix-int-small", "refil-small", "roma-small", "updet-mix-small"];

/// An empty folder of this test's own.
fn folder(test: &str) -> PathBuf {
    let folder = Path::new(env!("CARGO_TARGET_TMPDIR")).join("golden").join(test);
    if folder.exists() {
        fs::remove_dir_all(&folder).unwrap();
    }
    fs::create_dir_all(&folder).unwrap();
    folder
}

/// A copy of one of the repository's cases, to be changed.
fn copy(case: &str, to: &Path) -> PathBuf {
    let (from, to) = (Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/golden").join(case), to.join(case));
    fs::create_dir_all(&to).unwrap();
    for entry in fs::read_dir(from).unwrap() {
        let path = entry.unwrap().path();
        fs::copy(&path, to.join(path.file_name().unwrap())).unwrap();
    }
    to
}

/// A tensor's type, its shape, and its numbers as they are stored.
type Held = (Dtype, Vec<usize>, Vec<u8>);

/// Rewrites a file of a case.
fn rewrite(folder: &Path, file: &str, change: impl FnOnce(&mut BTreeMap<String, Held>)) {
    let path = folder.join(file).with_extension("safetensors");
    let bytes = fs::read(&path).unwrap();
    let tensors = SafeTensors::deserialize(&bytes).unwrap().tensors();
    let held = |tensor: &TensorView<'_>| (tensor.dtype(), tensor.shape().to_vec(), tensor.data().to_vec());
    let mut held: BTreeMap<String, Held> =
        tensors.iter().map(|(name, tensor)| (name.clone(), held(tensor))).collect();
    change(&mut held);
    let views = held.iter().map(|(name, (dtype, shape, data))| {
        (name.as_str(), TensorView::new(*dtype, shape.clone(), data).unwrap())
    });
    fs::write(&path, safetensors::serialize(views, None).unwrap()).unwrap();
}

/// Changes the numbers of one tensor of type f32.
fn change(folder: &Path, file: &str, name: &str, change: impl FnOnce(&mut [f32], &[usize])) {
    rewrite(folder, file, |held| {
        let (_, shape, data) = held.get_mut(name).unwrap();
        let mut numbers: Vec<f32> =
            data.as_chunks::<4>().0.iter().map(|&word| f32::from_le_bytes(word)).collect();
        change(&mut numbers, shape);
        *data = numbers.iter().flat_map(|number| number.to_le_bytes()).collect();
    });
}

/// Changes `case.json`.
fn describe(folder: &Path, change: impl FnOnce(&mut Value)) {
    let path = folder.join("case.json");
    let mut case: Value = serde_json::from_slice(&fs::read(&path).unwrap()).unwrap();
    change(&mut case);
    fs::write(&path, case.to_string()).unwrap();
}

#[test]
fn cases_lie_at_any_depth() {
    let root = folder("depth");
    for case in ["b/of/many/levels", "b/of", "a", "c"] {
        fs::create_dir_all(root.join(case)).unwrap();
        fs::write(root.join(case).join("case.json"), "{}").unwrap();
    }
    fs::create_dir_all(root.join("b/notes")).unwrap();
    fs::write(root.join("b/notes/other.json"), "{}").unwrap();
    let expected = ["a", "b/of", "b/of/many/levels", "c"].map(|case| root.join(case));
    assert_eq!(cases_under(&root), expected);
    assert_eq!(cases_under(&root.join("a")), [root.join("a")], "a folder that is one itself");
}

#[test]
fn a_case_may_lack_what_is_optional_and_hold_what_is_not_used() {
    let root = folder("optional");
    for case in CASES {
        let folder = copy(case, &root);
        fs::remove_file(folder.join("weights_after_step.safetensors")).unwrap();
        describe(&folder, |case| {
            let scalars = case["scalars"].as_object_mut().unwrap();
            scalars.retain(|name, _| name != "loss" && name != "entropy");
        });
        let more = ("other.weight".to_owned(), (Dtype::F32, vec![2], vec![0; 8]));
        for file in ["weights", "target_weights", "start_weights"] {
            if folder.join(file).with_extension("safetensors").exists() {
                rewrite(&folder, file, |held| held.extend([more.clone()]));
            }
        }
        assert_eq!(differences(&folder), [""; 0], "{case}");
    }
}

/// An implementation without a gradient for what nothing led to stores none; flags and numbers may be stored otherwise.
#[test]
fn a_case_may_store_its_numbers_otherwise() {
    let root = folder("stored");
    let folder = copy("mat-small", &root);
    rewrite(&folder, "batch", |held| {
        let (dtype, _, data) = held.get_mut("actions").unwrap();
        let wider = |word: &[u8; 4]| i64::from(i32::from_le_bytes(*word)).to_le_bytes();
        *data = data.as_chunks::<4>().0.iter().flat_map(wider).collect();
        *dtype = Dtype::I64;
        let (dtype, _, data) = held.get_mut("present").unwrap();
        let flag = |word: &[u8; 4]| u8::from(f32::from_le_bytes(*word) == 1.0);
        *data = data.as_chunks::<4>().0.iter().map(flag).collect();
        *dtype = Dtype::BOOL;
    });
    assert_eq!(differences(&folder), [""; 0]);

    // Softmax does not see a key's bias: its gradient is zero.
    let folder = copy("vdn-attn-small", &root);
    fs::remove_file(folder.join("weights_after_step.safetensors")).unwrap();
    rewrite(&folder, "gradients", |held| drop(held.remove("utility.attention.key.bias").unwrap()));
    assert_eq!(differences(&folder), [""; 0]);
    rewrite(&folder, "gradients", |held| drop(held.remove("utility.head.bias").unwrap()));
    let found = differences(&folder);
    assert!(found.len() == 3 && found[0].contains("gradient of utility.head.bias[0]"), "{found:?}");
}

#[test]
fn a_number_that_differs_is_found_and_named() {
    let root = folder("differs");
    // The first number of the first cell is real everywhere.
    let nudge = |numbers: &mut [f32], _: &[usize]| numbers[0] += 0.01;
    for (case, file, tensor, named) in [
        ("mappo-small", "expected", "logits", "logits[0]"),
        ("mat-small", "gradients", "decoder.head.bias", "gradient of decoder.head.bias[0]"),
        ("qmix-int-small", "expected", "q_total", "q_total[0]"),
        ("refil-small", "expected", "imagined_q_total", "imagined_q_total[0]"),
        ("roma-small", "expected", "role_information", "role_information[0]"),
        ("updet-mix-small", "weights_after_step", "utility.head.bias", "utility.head.bias after one step[0]"),
    ] {
        let folder = copy(case, &root);
        change(&folder, file, tensor, nudge);
        let found = differences(&folder);
        assert!(found.iter().any(|line| line.contains(&format!(": {named} is "))), "{case}: {found:?}");
    }
    let folder = copy("vdn-attn-small", &root);
    describe(&folder, |case| case["scalars"]["td_loss"] = Value::from(123.0));
    let found = differences(&folder);
    assert!(found.len() == 3 && found.iter().all(|line| line.contains(": td_loss[0] is ")), "{found:?}");
}

#[test]
fn what_cannot_be_read_is_said_with_its_case_and_its_file() {
    let root = folder("unreadable");
    let said = |folder: &Path, words: &[&str]| {
        let found = differences(folder);
        let says = |line: &String| {
            line.starts_with(&folder.display().to_string())
                && line.contains("cannot be compared")
                && words.iter().all(|word| line.contains(word))
        };
        assert!(found.len() == 3 && found.iter().all(says), "{words:?} in {found:?}");
    };
    for case in ["mappo-small", "vdn-attn-small"] {
        let folder = copy(case, &root);
        describe(&folder, |case| case["scalars"]["speed"] = Value::from(1.0));
        said(&folder, &["case.json", "speed"]);
        let folder = copy(case, &root);
        fs::remove_file(folder.join("weights.safetensors")).unwrap();
        said(&folder, &["weights.safetensors"]);
        let folder = copy(case, &root);
        fs::write(folder.join("gradients.safetensors"), "torn").unwrap();
        said(&folder, &["gradients.safetensors"]);
        let folder = copy(case, &root);
        rewrite(&folder, "batch", |held| drop(held.remove("present")));
        said(&folder, &["batch.safetensors", "present"]);
        let folder = copy(case, &root);
        fs::write(folder.join("case.json"), "{").unwrap();
        said(&folder, &["case.json"]);
        let folder = copy(case, &root);
        describe(&folder, |case| drop(case["config"].as_object_mut().unwrap().remove("hidden_dim")));
        said(&folder, &["case.json", "hidden_dim"]);
    }
}

/// Every episode's first agent is all alone, and so is an episode's first step. What the reference says is of other
/// episodes then, so numbers differ; but each of them can be read.
#[test]
fn lone_agents_and_single_steps_can_be_compared() {
    let root = folder("alone");
    for case in CASES {
        let folder = copy(case, &root);
        let mut agents_max = 0;
        describe(&folder, |case| agents_max = case["config"]["agents_max"].as_u64().unwrap() as usize);
        change(&folder, "batch", "present", |present, shape| {
            for present in present.chunks_mut(shape[1]) {
                present[1..agents_max].fill(0.0);
            }
        });
        change(&folder, "batch", "filled", |filled, shape| filled[1..shape[1]].fill(0.0));
        let found = differences(&folder);
        let unread: Vec<_> = found.iter().filter(|line| line.contains("cannot be compared")).collect();
        assert!(unread.is_empty() && !found.is_empty(), "{case}: {unread:?}");
    }
}
