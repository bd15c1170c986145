//! Numeric gradients, for tests of this crate and of those above it.

use crate::{
    View,
    tape::{Stock, Tape, Var},
};

/// Deterministic noise in (−1, 1), away from zero so that ReLUs do not sit on their kink.
pub fn noise(seed: u64, len: usize) -> Vec<f32> {
    let mut state = seed.wrapping_mul(0x9e37_79b9_7f4a_7c15) | 1;
    let mut next = || {
        // xorshift64*
        state ^= state >> 12;
        state ^= state << 25;
        state ^= state >> 27;
        (state.wrapping_mul(0x2545_f491_4f6c_dd1d) >> 40) as f32 / (1_u64 << 24) as f32
    };
    (0..len)
        .map(|_| {
            let value = 2.0 * next() - 1.0;
            value + 0.02 * value.signum()
        })
        .collect()
}

/// Compares a gradient with central differences of the loss, element by element. A ReLU's kink inside the
/// larger step is most likely outside the smaller one, so an element may agree with either.
///
/// # Panics
/// Where they differ by more than 1 % of the largest element plus what f32 rounding explains.
pub fn check(name: &str, at: &[f32], gradient: &[f32], loss: impl Fn(&[f32]) -> f64) {
    const STEPS: [f32; 2] = [2e-3, 2e-4];
    assert_eq!(at.len(), gradient.len());
    assert!(gradient.iter().any(|&g| g != 0.0), "{name}: a gradient of zeros shows nothing");
    let largest = gradient.iter().fold(0.0_f32, |largest, g| largest.max(g.abs()));
    let scale = loss(at).abs().max(1.0) as f32;
    let mut moved = at.to_vec();
    for element in 0..at.len() {
        let mut difference = |step: f32| {
            moved[element] = at[element] + step;
            let above = loss(&moved);
            moved[element] = at[element] - step;
            let below = loss(&moved);
            moved[element] = at[element];
            ((above - below) / f64::from(2.0 * step)) as f32
        };
        let agrees = |numeric: f32, step: f32| {
            // Rounding of the loss, about 1e-7 of it, divided by the step.
            (numeric - gradient[element]).abs() <= 1e-2 * largest + 2e-7 * scale / step
        };
        let mut numeric = 0.0;
        let found = STEPS.into_iter().any(|step| {
            numeric = difference(step);
            agrees(numeric, step)
        });
        assert!(found, "{name}[{element}]: {} written, {numeric} measured", gradient[element]);
    }
}

/// What an operation makes of these parameters and inputs, `(numbers, columns)` each: on a tape that records nothing.
pub fn run_operation<'a>(
    params: &[f32],
    inputs: &[(&[f32], usize)],
    operation: impl Fn(&mut Tape<'a>, &[Var]) -> Var,
) -> Vec<f32> {
    let mut tape = Tape::inference(forever(params), Stock::default());
    let inputs: Vec<Var> =
        inputs.iter().map(|&(data, cols)| tape.input(View::dense(forever(data), cols))).collect();
    let out = operation(&mut tape, &inputs);
    let view = tape.view(out);
    (0..view.rows).flat_map(|row| view.row(row)).copied().collect()
}

/// Compares an operation's gradients by its parameters and by inputs of these shapes with numeric ones; the loss is a
/// random weighing of its output. Also: a tape that records gives the same values as one that does not, and gradients
/// come twice as large where the output is used twice.
///
/// # Panics
/// Where they differ.
pub fn check_operation<'a>(
    params: usize,
    inputs: &[(usize, usize)],
    operation: impl Fn(&mut Tape<'a>, &[Var]) -> Var,
) {
    let params = noise(1, params);
    let at: Vec<(Vec<f32>, usize)> =
        (2..).zip(inputs).map(|(seed, &(rows, cols))| (noise(seed, rows * cols), cols)).collect();
    let mut grads = vec![0.0; params.len()];
    let mut tape = Tape::recording(forever(&params), Stock::default());
    let inputs: Vec<Var> =
        at.iter().map(|(data, cols)| tape.input(View::dense(forever(data), *cols))).collect();
    let out = operation(&mut tape, &inputs);
    let to = noise(99, out.len());
    let half: Vec<f32> = to.iter().map(|to| 0.5 * to).collect();
    for _ in 0..2 {
        tape.seed(out, View::dense(&half, out.cols));
    }
    let run = |params: &[f32], at: &[(Vec<f32>, usize)]| {
        let inputs: Vec<(&[f32], usize)> = at.iter().map(|(data, cols)| (&data[..], *cols)).collect();
        run_operation(params, &inputs, &operation)
    };
    let recorded: Vec<f32> = (0..out.rows).flat_map(|row| tape.view(out).row(row)).copied().collect();
    assert_eq!(recorded, run(&params, &at), "values do not depend on what is recorded");
    tape.backward(&mut grads);

    let loss = |params: &[f32], at: &[(Vec<f32>, usize)]| {
        run(params, at).iter().zip(&to).map(|(y, to)| f64::from(y * to)).sum()
    };
    if !params.is_empty() {
        check("params", &params, &grads, |params| loss(params, &at));
    }
    for (index, &input) in inputs.iter().enumerate() {
        let gradient = tape.gradient(input);
        let gradient: Vec<f32> = (0..gradient.rows).flat_map(|row| gradient.row(row)).copied().collect();
        check(&format!("input {index}"), &at[index].0, &gradient, |values| {
            let mut moved = at.clone();
            moved[index].0.copy_from_slice(values);
            loss(&params, &moved)
        });
    }
}

/// A copy that outlives every tape: operations borrow what a test made, for a time that the test chooses.
fn forever(data: &[f32]) -> &'static [f32] {
    data.to_vec().leak()
}
