use super::*;
use crate::gradcheck::{check, noise};

const INPUTS: usize = 5;
const DIM: usize = 6;
const QUERIES: usize = 3 + LARGE;
const KEYS: usize = 5 + LARGE + 1;

/// 2 queries over 3 keys, 1 query over 2 keys, and a large group.
fn groups() -> [Group; 3] {
    [
        Group { queries: 0..2, keys: 0..3 },
        Group { queries: 2..3, keys: 3..5 },
        Group { queries: 3..QUERIES, keys: 5..KEYS },
    ]
}

/// Query 1 does not see key 0, query 2 sees none, the large group's queries miss a key each.
fn seen() -> Vec<u8> {
    let large = (0..LARGE * (LARGE + 1)).map(|pair| u8::from(pair % (LARGE + 2) != 0));
    [1, 1, 1, 0, 1, 1, 0, 0].into_iter().chain(large).collect()
}

fn unit(heads: usize) -> (Attention, usize) {
    let mut layout = LayoutBuilder::default();
    let attention = Attention::new(&mut layout, "attention", INPUTS, DIM, heads);
    (attention, layout.len())
}

/// With any number of heads that split the attention, with ReLU on the values and without.
fn units() -> impl Iterator<Item = (Attention, usize)> {
    [1, 2, 3].into_iter().flat_map(|heads| {
        let (attention, len) = unit(heads);
        let linear = Attention::linear(&mut LayoutBuilder::default(), "attention", INPUTS, DIM, heads);
        [(attention, len), (linear, len)]
    })
}

fn run(
    attention: &Attention,
    params: &[f32],
    xq: &[f32],
    xk: &[f32],
    visible: Visible<'_>,
) -> (Vec<f32>, AttentionState) {
    let (mut out, mut state) = (vec![9.0; QUERIES * DIM], AttentionState::default());
    let (xq, xk) = (View::dense(xq, INPUTS), View::dense(xk, INPUTS));
    attention.project(params, xq, xk, &mut state);
    attention.attend(&groups(), visible, &mut state, ViewMut::dense(&mut out, DIM));
    (out, state)
}

/// Equations 12-14, one number at a time.
fn reference(attention: &Attention, params: &[f32], xq: &[f32], xk: &[f32], seen: &[u8]) -> Vec<f32> {
    let project = |linear: &Linear, x: &[f32]| -> Vec<f32> {
        let mut y = vec![0.0; x.len() / INPUTS * linear.outputs];
        linear.forward(params, View::dense(x, INPUTS), ViewMut::dense(&mut y, linear.outputs));
        y
    };
    let (q, kv) = (project(&attention.query, xq), project(&attention.key_value, xk));
    let head_dim = DIM / attention.heads;
    let mut out = vec![0.0; QUERIES * DIM];
    let mut at = 0;
    for group in groups() {
        for query in group.queries.clone() {
            let flags = &seen[at..at + group.keys.len()];
            at += group.keys.len();
            for column in 0..DIM {
                let head = column / head_dim * head_dim..(column / head_dim + 1) * head_dim;
                let weight = |key: usize| -> f32 {
                    let score: f32 = head.clone().map(|c| q[query * DIM + c] * kv[key * 2 * DIM + c]).sum();
                    (score / (head_dim as f32).sqrt()).exp()
                };
                let keys =
                    || group.keys.clone().zip(flags).filter(|(_, seen)| **seen == 1).map(|(key, _)| key);
                let total: f32 = keys().map(weight).sum();
                let value = |key: usize| match attention.values {
                    Values::Rectified => kv[key * 2 * DIM + DIM + column].max(0.0),
                    Values::Linear => kv[key * 2 * DIM + DIM + column],
                };
                let sum: f32 = keys().map(|key| weight(key) * value(key)).sum();
                out[query * DIM + column] = if total > 0.0 { sum / total } else { 0.0 };
            }
        }
    }
    out
}

#[test]
fn follows_the_equations() {
    for (attention, len) in units() {
        let (params, xq, xk) = (noise(1, len), noise(2, QUERIES * INPUTS), noise(3, KEYS * INPUTS));
        let (all, seen) = (vec![1; seen().len()], seen());
        for (visible, seen) in [(Visible::All, &all), (Visible::Where(&seen), &seen)] {
            let (out, _) = run(&attention, &params, &xq, &xk, visible);
            for (a, b) in out.iter().zip(reference(&attention, &params, &xq, &xk, seen)) {
                assert!((a - b).abs() < 1e-5, "{attention:?}: {a} {b}");
            }
        }
    }
}

/// Gradients of queries, keys and parameters. The first two are written over, whatever lay there.
fn backward(
    attention: &Attention,
    params: &[f32],
    xq: &[f32],
    xk: &[f32],
    state: &AttentionState,
    d_out: &[f32],
) -> (Vec<f32>, Vec<f32>, Vec<f32>) {
    let (mut dxq, mut dxk, mut grads) = (vec![9.0; xq.len()], vec![9.0; xk.len()], vec![0.0; params.len()]);
    attention.backward(
        params,
        View::dense(xq, INPUTS),
        View::dense(xk, INPUTS),
        &groups(),
        state,
        View::dense(d_out, DIM),
        ViewMut::dense(&mut dxq, INPUTS),
        ViewMut::dense(&mut dxk, INPUTS),
        &mut grads,
        &mut Scratch::default(),
    );
    (dxq, dxk, grads)
}

#[test]
fn who_sees_nothing_gets_exactly_zero_and_passes_no_gradient() {
    let (attention, len) = unit(2);
    let (params, xq, xk) = (noise(1, len), noise(2, QUERIES * INPUTS), noise(3, KEYS * INPUTS));
    let (out, state) = run(&attention, &params, &xq, &xk, Visible::Where(&seen()));
    assert_eq!(out[2 * DIM..3 * DIM], [0.0; DIM]);
    let (dxq, dxk, _) = backward(&attention, &params, &xq, &xk, &state, &noise(4, QUERIES * DIM));
    assert_eq!(dxq[2 * INPUTS..3 * INPUTS], [0.0; INPUTS]);
    assert_eq!(dxk[3 * INPUTS..5 * INPUTS], [0.0; 2 * INPUTS]);
}

/// Weights as those of trained networks, which are sure of where to look: what else there is gets exactly nothing,
/// and no gradient of it is subnormal.
#[test]
fn what_weighs_next_to_nothing_weighs_nothing() {
    let (attention, len) = unit(1);
    let large = |seed, len| -> Vec<f32> { noise(seed, len).iter().map(|x| 12.0 * x).collect() };
    let (params, xq, xk) = (large(1, len), large(2, QUERIES * INPUTS), large(3, KEYS * INPUTS));
    let (_, state) = run(&attention, &params, &xq, &xk, Visible::All);
    assert!(state.weights.contains(&0.0) && state.weights.iter().all(|&w| w == 0.0 || w > 1e-21));
    let d_out: Vec<f32> = noise(4, QUERIES * DIM).iter().map(|d| 1e-6 * d).collect();
    let (dxq, dxk, grads) = backward(&attention, &params, &xq, &xk, &state, &d_out);
    assert!([dxq, dxk, grads].concat().iter().all(|d| !d.is_subnormal()));
}

#[test]
fn gradients_are_the_numeric_ones() {
    let seen = seen();
    for (attention, len) in units() {
        let visible = if attention.heads == 2 { Visible::Where(&seen) } else { Visible::All };
        let (params, xq, xk, to) =
            (noise(1, len), noise(2, QUERIES * INPUTS), noise(3, KEYS * INPUTS), noise(4, QUERIES * DIM));
        let loss = |params: &[f32], xq: &[f32], xk: &[f32]| {
            let (out, _) = run(&attention, params, xq, xk, visible);
            out.iter().zip(&to).map(|(out, to)| f64::from(out * to)).sum()
        };
        let (_, state) = run(&attention, &params, &xq, &xk, visible);
        let (dxq, dxk, grads) = backward(&attention, &params, &xq, &xk, &state, &to);
        check("params", &params, &grads, |params| loss(params, &xq, &xk));
        check("queries", &xq, &dxq, |xq| loss(&params, xq, &xk));
        check("keys", &xk, &dxk, |xk| loss(&params, &xq, xk));
    }
}

/// Three masks over one set of projections: each query's row under a mask is what that mask alone gives, and
/// gradients are the numeric ones of all three together.
#[test]
fn several_masks_are_several_passes() {
    let first = seen();
    let third: Vec<u8> = first.iter().enumerate().map(|(at, seen)| seen ^ u8::from(at % 3 == 0)).collect();
    let masks = [Visible::Where(&first), Visible::All, Visible::Where(&third)];
    for heads in [1, 2] {
        let (attention, len) = unit(heads);
        let (params, xq, xk) = (noise(1, len), noise(2, QUERIES * INPUTS), noise(3, KEYS * INPUTS));
        let to = noise(4, 3 * QUERIES * DIM);
        let run_all = |params: &[f32], xq: &[f32], xk: &[f32]| {
            let (mut out, mut state) = (vec![9.0; 3 * QUERIES * DIM], AttentionState::default());
            attention.project(params, View::dense(xq, INPUTS), View::dense(xk, INPUTS), &mut state);
            attention.attend_masks(&groups(), &masks, &mut state, ViewMut::dense(&mut out, DIM));
            (out, state)
        };
        let (out, state) = run_all(&params, &xq, &xk);
        for (mask, visible) in masks.into_iter().enumerate() {
            let (alone, _) = run(&attention, &params, &xq, &xk, visible);
            for query in 0..QUERIES {
                let row = &out[(query * 3 + mask) * DIM..][..DIM];
                for (a, b) in row.iter().zip(&alone[query * DIM..]) {
                    assert!((a - b).abs() < 1e-6, "mask {mask}, query {query}: {a} {b}");
                }
            }
        }
        let loss = |params: &[f32], xq: &[f32], xk: &[f32]| {
            run_all(params, xq, xk).0.iter().zip(&to).map(|(out, to)| f64::from(out * to)).sum()
        };
        let (dxq, dxk, grads) = backward(&attention, &params, &xq, &xk, &state, &to);
        check("params", &params, &grads, |params| loss(params, &xq, &xk));
        check("queries", &xq, &dxq, |xq| loss(&params, xq, &xk));
        check("keys", &xk, &dxk, |xk| loss(&params, &xq, xk));
    }
}
