"""The command lines, by what they exercise: a list, so long because the commands are many."""

from __future__ import annotations

from collections.abc import Iterator

from benchmarks.golden.steps import Group, Step, group_of, single_steps

SMALL = "refine ../in/small/rgb.png --sparse ../in/small/sparse.png"
GT = "--gt ../in/small/gt.png"
STREET = "--calib ../in/street_small/calib.txt"
KITTI = "../in/kitti_small"
USERS = "--model ../in/my_net.py:MyNet --checkpoint ../in/my_net.safetensors"


def groups() -> Iterator[Group]:
    """All of them, the longest first, so that several jobs end together."""
    yield from _of_shared_data()
    yield from _of_refinement()
    yield from _of_many_frames()
    yield from _of_sparse_depth()
    yield from _of_networks()
    yield from _of_errors()


def _of_shared_data() -> Iterator[Group]:
    data, onnx = "../shared", "--model ../shared/weights/fastdepth_nyu.onnx"
    scenes = f"{data}/7scenes/frame-000000"
    crop = f"{KITTI}/image/0000000005.png --sparse {KITTI}/velodyne_raw/0000000005.png"
    gt = f"--gt {KITTI}/groundtruth/0000000005.png"
    nconv = f"--model nconv --checkpoint {data}/weights/nconv"
    pncnn = f"--model pncnn --checkpoint {data}/weights/pncnn"
    yield group_of(
        "kitti-dc",
        (
            "batch",
            f"batch {data}/kitti_dc -o out --limit 1 --workers 1 --model sparse2dense-tiny-kitti",
        ),
        (
            "eval",
            f"eval out {data}/kitti_dc --protocol kitti --sparse {data}/kitti_dc/velodyne_raw",
        ),
        shared=True,
        unordered=True,
    )
    yield group_of(
        "kitti-object",
        ("dry-run", f"batch {data}/kitti_object -o out --dry-run"),
        ("batch", f"batch {data}/kitti_object -o out --limit 1 --model eigen-tiny --holdout 0.1"),
        shared=True,
        unordered=True,
    )
    yield from single_steps(
        "kitti-scan",
        (
            "project",
            f"project {data}/kitti_object/velodyne/000001.bin --calib"
            f" {data}/kitti_object/calib/000001.txt --image {data}/kitti_object/image_2/000001.png"
            " -o scan.png --overlay overlay.png --json",
        ),
        (
            "keep-occluded",
            f"project {data}/kitti_object/velodyne/000002.bin --calib"
            f" {data}/kitti_object/calib/000002.txt --size 370x1224 --camera 3"
            " --scan keep-occluded,euclidean,min-range=5,max-range=40 -o scan.csv",
        ),
        (
            "raw",
            f"project {data}/kitti_object/velodyne/000003.bin --calib {data}/kitti_dc"
            " --size 375x1242 -o scan.npz",
        ),
        shared=True,
    )
    yield group_of(
        "nconv",
        ("refine", f"refine {crop} {gt} {nconv}/CNN_ep0003.pth.tar -o out --json"),
        ("module", f"refine {crop} {gt} {nconv}/whole_module.pth -o depth.npy"),
        ("eval", f"eval depth.npy {KITTI}/groundtruth/0000000005.png --protocol kitti-devkit"),
        ("convert", f"models --convert {data}/weights/nconv/whole_module.pth nconv.safetensors"),
        ("converted", f"refine {crop} --model nconv --checkpoint nconv.safetensors -o d.exr"),
        shared=True,
    )
    yield group_of(
        "pncnn",
        (
            "refine",
            f"refine {crop} {gt} {pncnn}/kitti_model_best.pth.tar --iterations 2 -o o --format exr",
        ),
        ("layers", f"layers {pncnn}/nyu_model_best.pth.tar --size 64x96 --json"),
        shared=True,
    )
    yield group_of(
        "fastdepth",
        (
            "refine",
            f"refine {scenes}.color.jpg --sparse {scenes}.depth.png --depth-scale 1000 {onnx}"
            f" --gt {scenes}.depth.png --gt-scale 1000 --iterations 2 -o out",
        ),
        (
            "few-points",
            f"{SMALL} {onnx} --layer Relu_322 --update adam --lr 3% --iterations 5 --align auto"
            f" {GT} --holdout 0.25 -o few --format tiff",
        ),
        ("check", f"models --check {data}/weights/fastdepth_nyu.onnx --image ../in/small/rgb.png"),
        Step(name="fastdepth/layers", line=f"layers {onnx} --sparse ../in/small/sparse.png --json"),
        ("no-layer", f"{SMALL} {onnx} --layer Relu_9999 -o none"),
        shared=True,
    )
    yield group_of(
        "fastdepth-auto",
        ("auto", f"{SMALL} {onnx} --baselines {GT} -o out --format npy"),
        shared=True,
    )
    yield group_of(
        "7scenes",
        (
            "batch",
            f"batch {data}/7scenes -o out --limit 2 --sample 300 --protocol nyu --workers 1"
            " --iterations 2 --batch-size 1",
        ),
        ("eval", f"eval out {data}/7scenes --bootstrap 50 --json"),
        shared=True,
        unordered=True,
    )
    yield group_of(
        "icl",
        (
            "eigen",
            f"refine {data}/icl_nuim/image/00005.jpg --sparse ../in/points.csv --gt"
            f" {data}/icl_nuim/depth/00005.png --gt-scale 1000 --model eigen-tiny -o out",
        ),
        shared=True,
    )


def _of_refinement() -> Iterator[Group]:
    indoor = "refine ../in/indoor/rgb.png --sparse ../in/indoor/sparse.png"
    yield from single_steps(
        "readme",
        ("indoor", f"{indoor} --gt ../in/indoor/gt.png -o out/ --overwrite"),
        ("default-output", f"{indoor} --model eigen-tiny"),
        (
            "scan",
            "refine ../in/street/rgb.png --sparse ../in/street/000000.bin --calib"
            " ../in/street/calib.txt --gt ../in/street/gt.png -o street-scan/ --iterations 1",
        ),
        (
            "settings",
            f"{indoor} --layer decoder.s8 --iterations 3 --lr 3% --loss l2 --update adam"
            " -o depth.exr",
        ),
    )
    yield from single_steps(
        "auto",
        ("auto", f"{SMALL} {GT} --baselines --uncertainty -o best/"),
        ("no-time", f"{SMALL} {GT} --time-budget 0.000001s -o best/ --json"),
        ("few-points", "refine ../in/small/rgb.png --sparse ../in/few.csv -o best/"),
        ("eigen", f"{SMALL} {GT} --model eigen-tiny --uncertainty -o best/"),
        (
            "gp",
            f"{SMALL} {GT} --propagate gp --layer decoder.s4 --seed 3 -o best/",
        ),
        (
            "lines",
            "refine ../in/street_small/rgb.png --sparse ../in/street_small/sparse.png"
            " --model sparse2dense-tiny --gt ../in/street_small/gt.png -o best/",
        ),
    )
    yield from single_steps(
        "networks",
        *(
            (f"{name}-tiny", f"{indoor} --gt ../in/indoor/gt.png --model {name}-tiny -o out/")
            for name in ("eigen", "fcrn", "sfmlearner", "sparse2dense", "latefusion")
        ),
        ("sparseconv-tiny", f"{SMALL} {GT} --model sparseconv-tiny -o out/ --format npy"),
        ("adnn-tiny", f"{SMALL} {GT} --model adnn-tiny -o out/ --format exr"),
        (
            "sparse2dense-tiny-kitti",
            "refine ../in/street/rgb.png --sparse ../in/street/sparse.png --model"
            " sparse2dense-tiny-kitti -o out/ --format npz",
        ),
        ("sparse-only", "refine --sparse ../in/small/sparse.png --model sparseconv-tiny -o d.npy"),
        (
            "sfmlearner-align",
            f"{SMALL} {GT} --model sfmlearner-tiny --align auto -o out/",
        ),
        (
            "eigen-align-every",
            f"{SMALL} --model eigen-tiny --align affine --set align-every -o out/",
        ),
    )
    yield from single_steps(
        "losses",
        *(
            (loss, f"{SMALL} {GT} --loss {loss} -o out/ --format npy")
            for loss in ("l1", "l2", "huber", "berhu", "inverse", "log", "cauchy")
        ),
    )
    yield from single_steps(
        "updates",
        *(
            (update, f"{SMALL} {GT} --update {update} --lr 2% -o out/ --format npy")
            for update in ("sign", "sgd", "normalised", "momentum", "adam", "lbfgs")
        ),
        ("adam-own-lr", f"{SMALL} {GT} --update adam -o out/ --format npy"),
    )
    yield from single_steps(
        "options",
        ("linear", f"{SMALL} --set schedule=linear --lr 0.02 --iterations 3 -o out/"),
        ("spread", f"{SMALL} --set blur=1.5 --update normalised --lr 5% -o out/"),
        ("channels", f"{SMALL} {GT} --set parameters=channels -o out/"),
        (
            "channels-lbfgs",
            f"{SMALL} --set parameters=channels --update lbfgs -o out/ --iterations 3",
        ),
        ("anchor", f"{SMALL} {GT} --set proximity=0.1 -o out/"),
        ("line-search", f"{SMALL} {GT} --set line-search --lr 30% -o out/"),
        ("keep-best", f"{SMALL} {GT} --set keep-best --lr 50% --iterations 8 -o out/"),
        ("plain", f"{SMALL} {GT} --iterations 0 -o out/"),
        ("share", f"{SMALL} --layer 0.5 -o out/ --iterations 2"),
        ("layer", f"{SMALL} --layer decoder.s2 -o out/ --iterations 2"),
        ("gp", f"{SMALL} {GT} --propagate gp --uncertainty -o out/"),
        ("diffusion", f"{SMALL} {GT} --propagate diffusion -o out/"),
        ("baselines", f"{SMALL} {GT} --baselines -o out/"),
        ("uncertainty", f"{SMALL} {GT} --uncertainty --holdout 0.2 -o out/ --format exr"),
        ("holdout", f"{SMALL} --holdout 0.3 --seed 4 -o out/ --json"),
        ("tile", f"{SMALL} {GT} --tile 96 -o out/"),
        ("bf16", f"{SMALL} {GT} --precision bf16 -o out/"),
        ("align-median", f"{SMALL} {GT} --align median -o out/"),
        ("align-scale", f"{SMALL} {GT} --align scale -o out/"),
        ("align-affine", f"{SMALL} {GT} --align affine -o out/"),
        ("align-auto", f"{SMALL} {GT} --align auto -o out/"),
        (
            "wrong-scale",
            f"{SMALL} --depth-scale 100 --gt ../in/small/gt.png --gt-scale 256 -o out/",
        ),
        (
            "scan",
            f"refine ../in/street_small/rgb.png --sparse ../in/street_small/000000.bin {STREET}"
            " --gt ../in/street_small/gt.png --scan max-range=50 --holdout 0.1 -o out/",
        ),
        (
            "range",
            f"refine ../in/street_small/rgb.png --sparse ../in/street_small/000000.bin {STREET}"
            " --scan euclidean,keep-occluded,min-range=4 --camera 3 --iterations 1 -o out/",
        ),
        ("csv-points", "refine ../in/small/rgb.png --sparse ../in/few.csv -o out/"),
        (
            "leak",
            "refine ../in/small/rgb.png --sparse ../in/small/gt.png --gt ../in/small/gt.png -o o",
        ),
        (
            "size",
            "refine ../in/small/rgb.png --sparse ../in/indoor/sparse.png --sparse-size-ok -o out/",
        ),
        ("grey", "refine ../in/grey.png --sparse ../in/small/sparse.png -o out/ --iterations 1"),
    )
    yield group_of(
        "formats",
        *(
            (kind, f"{SMALL} -o {kind}/ --format {kind} --iterations 1")
            for kind in ("png", "exr", "npy", "npz", "pfm", "tiff")
        ),
        *(
            (
                f"read-{kind}",
                f"refine ../in/small/rgb.png --sparse ../in/small/sparse.png --gt"
                f" {kind}/rgb_depth.{kind} -o read-{kind}.npy --iterations 0",
            )
            for kind in ("png", "exr", "npy", "npz", "pfm", "tiff")
        ),
        *(
            (f"file-{kind}", f"{SMALL} -o depth.{kind} --iterations 1 {GT}")
            for kind in ("png", "exr", "npy", "npz", "pfm", "tiff")
        ),
        *(
            (f"sparse-{kind}", f"sample npy/rgb_depth.npy --count 80 --seed 2 -o s-{kind}.{kind}")
            for kind in ("exr", "npz", "pfm", "tiff", "csv")
        ),
        *(
            (
                f"from-{kind}",
                f"refine ../in/small/rgb.png --sparse s-{kind}.{kind} -o from-{kind}.npy"
                " --iterations 1",
            )
            for kind in ("exr", "npz", "pfm", "tiff", "csv")
        ),
        ("exists", f"{SMALL} -o depth.npy"),
        ("overwrite", f"{SMALL} -o depth.npy --overwrite --iterations 1"),
    )


def _of_many_frames() -> Iterator[Group]:
    batch = "--workers 1 --batch-size 1 --iterations 2"
    yield group_of(
        "batch",
        ("dry-run", f"batch ../in/pairs -o out {batch} --dry-run"),
        ("first", f"batch ../in/pairs -o out {batch} --limit 2"),
        ("rest", f"batch ../in/pairs -o out {batch} --html report --profile"),
        ("again", f"batch ../in/pairs -o out {batch}"),
        Step(
            name="batch/lost",
            line=f"batch ../in/pairs -o out {batch}",
            unordered=True,
            before=lambda folder: (folder / "out" / "b_depth.png").unlink(missing_ok=True),
        ),
        ("other-settings", f"batch ../in/pairs -o out {batch} --loss l2 --json --overwrite"),
        ("shard", f"batch ../in/pairs -o shard {batch} --shard 2/2"),
        ("eval", "eval out ../in/pairs --csv s.csv --markdown s.md --latex s.tex --html ev"),
        Step(
            name="batch/eval-json",
            line="eval out ../in/pairs --json --bootstrap 100 --sparse ../in/pairs/sparse",
            save="a.json",
            unordered=True,
        ),
        Step(
            name="batch/eval-other",
            line="eval shard ../in/pairs --json --bootstrap 100 --sparse ../in/pairs/sparse",
            save="b.json",
            unordered=True,
        ),
        Step(
            name="batch/eval-pooled",
            line="eval shard ../in/pairs --json --bootstrap 100 --exclude-sparse --sparse"
            " ../in/pairs/sparse --average pooled --max-depth 5",
            save="c.json",
            unordered=True,
        ),
        ("compare", "compare out/summary.json:before out/summary.json --csv c.csv --markdown c.md"),
        ("compare-json", "compare a.json b.json --bootstrap 200 --json --latex c.tex"),
        ("compare-other-rules", "compare a.json c.json"),
        ("compare-record", "compare out/a.json:before out/a.json"),
        unordered=True,
    )
    yield group_of(
        "batch-auto",
        (
            "auto",
            "batch ../in/many -o out --workers 1 --batch-size 1 --limit 2 --uncertainty"
            " --html report",
        ),
        unordered=True,
    )
    yield group_of(
        "batch-together",
        ("together", "batch ../in/many -o out --workers 1 --batch-size 4 --iterations 2"),
        unordered=True,
    )
    yield group_of(
        "manifests",
        ("csv", f"batch ../in/frames.csv -o csv {batch} --model eigen-tiny --format exr"),
        ("jsonl", f"batch ../in/frames.jsonl -o jsonl {batch} --holdout 0.2 --protocol whole"),
        ("broken", f"batch ../in/broken.csv -o broken {batch} --html report"),
        ("no-frames", f"batch ../in/empty -o none {batch}"),
        unordered=True,
    )
    sampled = f"{batch} --sample 200 --protocol whole --seed 1"
    yield group_of(
        "layouts",
        *(
            (name, f"batch ../in/layouts/{name} -o {name} {sampled}")
            for name in ("7scenes", "tum", "synthia", "nyu-h5", "nyu-mat")
        ),
        ("kitti-object", f"batch ../in/layouts/kitti-object -o object {batch}"),
        (
            "kitti-odometry",
            f"batch ../in/layouts/kitti-odometry -o odometry {batch} --protocol whole",
        ),
        ("kitti-depth", f"batch ../in/layouts/kitti-depth -o depth {batch}"),
        ("kitti-tree", f"batch ../in/layouts/kitti-tree -o tree {batch}"),
        ("named", f"batch ../in/pairs -o pairs {batch} --layout pairs --limit 1 --sample lines:8"),
        ("wrong-layout", f"batch ../in/pairs -o wrong {batch} --layout tum"),
        ("too-small", f"batch ../in/layouts/tum -o small {batch} --sample 20 --protocol nyu"),
        unordered=True,
    )
    yield group_of(
        "eval",
        ("predict", f"{SMALL} -o out --iterations 1"),
        ("file", "eval out/rgb_depth.png ../in/small/gt.png --markdown - --delta 1.01"),
        ("nyu", "eval ../in/indoor/gt.png ../in/indoor/gt.png --protocol nyu-eigen --csv -"),
        ("kitti", "eval ../in/street/sparse.png ../in/street/gt.png --protocol kitti --latex -"),
        ("devkit", "eval ../in/street/sparse.png ../in/street/gt.png --protocol kitti-devkit"),
        ("eigen", "eval ../in/street/sparse.png ../in/street/gt.png --protocol eigen --json"),
        ("garg", "eval ../in/street/sparse.png ../in/street/gt.png --protocol garg --no-clip"),
        (
            "crop",
            "eval out/rgb_depth.png ../in/small/gt.png --crop 10,10,60,50 --min-depth 1"
            " --max-depth 4 --average pooled --json",
        ),
        ("mask", "eval out/rgb_depth.png ../in/small/gt.png --mask ../in/grey.png"),
        ("resize", "eval out/rgb_depth.png ../in/indoor/gt.png --resize bilinear"),
        ("size", "eval out/rgb_depth.png ../in/indoor/gt.png"),
        ("scale", "eval out/rgb_depth.png ../in/small/gt.png --pred-scale 256"),
        ("leak", "eval out/rgb_depth.png ../in/small/gt.png --sparse ../in/small/sparse.png"),
        ("missing", "eval out ../in/pairs"),
        unordered=True,
    )
    sweep = "sweep ../in/pairs --limit 2"
    yield group_of(
        "sweep",
        ("points", f"{sweep} -o s --sample 100 --vary iterations=0,1,3 --seeds 2"),
        ("more", f"{sweep} -o s --sample 100 --vary iterations=0,1,2,3 --seeds 2"),
        (
            "grid",
            f"{sweep} -o g --vary points=50%,100% --vary update=sign,adam --iterations 1 --no-plots"
            " --json",
        ),
        (
            "one-by-one",
            f"{sweep} -o o --one-by-one --sample grid:60 --vary lr=1%,10% --vary layer=0,1 --vary"
            " loss=l1,log --vary noise=0,0.1 --vary propagate=none,gp --iterations 1 --no-plots",
        ),
        (
            "sensors",
            "sweep ../in/layouts/kitti-depth -o k --vary sensor=own,vlp-16,lines:4 --no-plots"
            " --iterations 1 --limit 1",
        ),
        ("nonsense", f"{sweep} -o n --vary colour=red"),
        unordered=True,
    )


def _of_sparse_depth() -> Iterator[Group]:
    sample = "sample ../in/small/gt.png"
    yield group_of(
        "sample",
        ("uniform", f"{sample} --pattern uniform --count 50 --seed 1 -o uniform.png"),
        ("bernoulli", f"{sample} --pattern bernoulli --count 5% --seed 2 -o bernoulli.npy"),
        ("grid", f"{sample} --pattern grid --count 60 -o grid.npz --json"),
        ("lines", f"{sample} --pattern lines --count 6 -o lines.exr"),
        (
            "features",
            f"{sample} --pattern features --count 40 --image ../in/small/rgb.png -o features.csv"
            " --overlay features_overlay.png",
        ),
        ("edges", f"{sample} --pattern edges --count 40 --image ../in/small/rgb.png -o e.tiff"),
        ("region", f"{sample} --pattern region --region 10,20,40,30 --count 30 -o region.pfm"),
        (
            "noise",
            f"{sample} --count 80 --noise 0.05 --relative-noise 0.02 --outliers 0.1 --jitter 1"
            " --seed 5 --output-scale 1000 -o noise.png",
        ),
        ("jitter-csv", f"{sample} --count 30 --jitter 0.4 -o jitter.csv"),
        ("no-image", f"{sample} --pattern features --count 40 -o none.png"),
        ("too-many", f"{sample} --count 10000000 -o many.png"),
    )
    simulate = "simulate ../in/street_small/gt.png"
    yield group_of(
        "simulate",
        *(
            (sensor, f"{simulate} --sensor {sensor} {STREET} --seed 1 -o {sensor}.png")
            for sensor in ("vlp-16", "vlp-32c", "hdl-32e", "hdl-64e", "paper-vlp-16")
        ),
        ("at-scanner", f"{simulate} --sensor vlp-16 {STREET} --at-scanner --json -o at.npy"),
        (
            "own",
            f"{simulate} --sensor ../in/lidar.toml {STREET} --offset 0.1 -0.2 0.3 --rotation-noise"
            " 0.3 --angle-noise 0.02 --range-noise 0.1 --dropout 0.2 --max-range 30 --range"
            " --seed 7 -o own.csv",
        ),
        ("unknown", f"{simulate} --sensor vlp-17 {STREET} -o none.png"),
    )
    project = f"project ../in/street_small/000000.bin {STREET}"
    yield group_of(
        "project",
        (
            "picture",
            f"{project} --image ../in/street_small/rgb.png -o scan.png --overlay overlay.png",
        ),
        ("exr", f"{project} --size 192x640 --scan keep-occluded -o kept.exr --json"),
        ("csv", f"{project} --size 192x640 --camera 0 --scan max-range=20 -o near.csv"),
        ("no-size", f"{project} -o none.png"),
        ("no-calib", "project ../in/street_small/000000.bin --size 192x640 -o none.png"),
    )


def _of_networks() -> Iterator[Group]:
    yield group_of(
        "models",
        ("list", "models"),
        ("json", "models --json"),
        ("check-compact", "models --check compact --image ../in/small/rgb.png"),
        (
            "check-user",
            "models --check ../in/my_net.py:MyNet --checkpoint ../in/my_net.safetensors",
        ),
        ("check-json", "models --check eigen-tiny --json"),
        ("check-none", "models --check ../in/none.onnx"),
        ("convert", "models --convert ../in/my_net.pt weights.safetensors"),
        ("convert-json", "models --convert ../in/my_net.pt other.safetensors --json"),
        ("convert-exists", "models --convert ../in/my_net.pt weights.safetensors"),
        ("convert-picture", "models --convert ../in/small/rgb.png none.safetensors"),
        ("fetch-nonsense", "models --fetch nonsense"),
    )
    yield group_of(
        "users-network",
        ("class", f"{SMALL} {GT} {USERS} --layer encode -o class/"),
        (
            "torch-file",
            f"{SMALL} --model ../in/my_net.py:make --checkpoint ../in/my_net.pt --layer encode"
            " --output-kind inverse --normalise imagenet --align affine -o torch-file/",
        ),
        (
            "definition",
            f"{SMALL} {GT} --model ../in/my_definition.py --checkpoint ../in/my_net.pt -o def/",
        ),
        ("layers", f"layers {USERS} --all --size 32x48"),
        ("layers-json", f"layers {USERS} --json --size 32x48"),
        (
            "other-weights",
            f"{SMALL} --model ../in/my_net.py:MyNet --checkpoint ../in/other.safetensors",
        ),
        ("no-weights", f"{SMALL} --model ../in/my_net.py:MyNet -o none"),
        ("no-class", f"{SMALL} --model ../in/my_net.py:YourNet -o none"),
        ("broken-file", f"{SMALL} --model ../in/broken.py -o none"),
        (
            "diverges",
            f"{SMALL} --model ../in/my_net.py:Exploding --checkpoint ../in/my_net.safetensors"
            " --layer encode --update sgd --lr 1e4 -o diverges/",
        ),
    )
    yield group_of(
        "archive",
        ("refine", f"{SMALL} --model ../in/net.pt2 -o out/"),
        ("layers", "layers --model ../in/net.pt2 --json"),
    )
    yield group_of(
        "hugging-face",
        ("refine", f"{SMALL} {GT} --model ../in/depth_anything -o out/ --format npy"),
        ("check", "models --check ../in/depth_anything --image ../in/small/rgb.png"),
    )
    yield group_of(
        "layers",
        ("compact", "layers --size 120x160"),
        ("json", "layers --json --size 96x128"),
        ("all", "layers --all --model eigen-tiny"),
        ("sparse", "layers --sparse ../in/small/sparse.png --model latefusion-tiny"),
    )
    bench = "bench --size 64x96 --repeats 1 --points 50"
    yield group_of(
        "bench",
        Step(name="bench/compact", line=bench, figures=False),
        Step(name="bench/json", line=f"{bench} --json --model eigen-tiny", figures=False),
        Step(name="bench/layer", line=f"{bench} --layer nothing", figures=False),
    )


def _of_errors() -> Iterator[Group]:
    out = "-o out"
    yield group_of(
        "help",
        *(
            (name, f"{name} --help")
            for name in (
                *("refine", "batch", "models", "layers", "project", "sample", "simulate", "eval"),
                *("compare", "sweep", "bench"),
            )
        ),
        ("help", "--help"),
        ("version", "--version"),
        ("nothing", ""),
        ("no-command", "refien"),
    )
    yield group_of(
        "errors",
        ("no-image", f"refine none.png --sparse ../in/small/sparse.png {out}"),
        ("no-sparse", f"refine ../in/small/rgb.png --sparse none.png {out}"),
        ("no-gt", f"{SMALL} --gt none.png {out}"),
        ("sparse-not-said", "refine ../in/small/rgb.png"),
        ("unknown-option", f"{SMALL} --nonsense {out}"),
        ("unknown-loss", f"{SMALL} --loss l3 {out}"),
        ("negative", f"{SMALL} --iterations -2 {out}"),
        ("bad-lr", f"{SMALL} --lr fast {out}"),
        ("bad-budget", f"{SMALL} --time-budget soon {out}"),
        ("budget-alone", f"{SMALL} --time-budget 3s {out}"),
        ("bad-spread", f"{SMALL} --set blur=nan {out}"),
        ("bad-anchor", f"{SMALL} --set proximity=-1 {out}"),
        ("bad-holdout", f"{SMALL} --holdout 1.5 {out}"),
        ("bad-tile", f"{SMALL} --tile 7 {out}"),
        ("wrong-layer", f"{SMALL} --layer decodr.s8 {out}"),
        ("wrong-model", f"{SMALL} --model compakt {out}"),
        ("needs-weights", f"{SMALL} --model eigen {out}"),
        ("wrong-checkpoint", f"{SMALL} --checkpoint ../in/my_net.safetensors {out}"),
        ("no-checkpoint", f"{SMALL} --checkpoint none.pt {out}"),
        ("text-checkpoint", f"{SMALL} --checkpoint ../in/few.csv {out}"),
        ("broken-image", f"refine ../in/broken.png --sparse ../in/small/sparse.png {out}"),
        ("broken-sparse", f"refine ../in/small/rgb.png --sparse ../in/broken.png {out}"),
        ("empty-sparse", f"refine ../in/small/rgb.png --sparse ../in/empty.npy {out}"),
        ("other-size", f"refine ../in/small/rgb.png --sparse ../in/indoor/sparse.png {out}"),
        (
            "scan-without-calib",
            f"refine ../in/small/rgb.png --sparse ../in/street/000000.bin {out}",
        ),
        ("calib-without-scan", f"{SMALL} {STREET} {out}"),
        (
            "broken-calib",
            "project ../in/street/000000.bin --calib ../in/few.csv --size 9x9 -o s.png",
        ),
        ("bad-scale", f"{SMALL} --depth-scale 0 {out}"),
        ("bad-output", f"{SMALL} -o ../in/few.csv/out"),
        ("bad-format", f"{SMALL} -o depth.jpg"),
        (
            "no-channel",
            f"refine ../in/small/rgb.png --sparse ../in/sparse.npz --channel Z {out}",
        ),
        ("no-device", f"{SMALL} --device nonsense {out}"),
        ("fp16-on-cpu", f"{SMALL} --precision fp16 {out}"),
        ("batch-no-folder", "batch none -o out"),
        ("batch-bad-shard", "batch ../in/pairs -o out --shard 5/4"),
        ("compare-one", "compare ../in/few.csv"),
        ("compare-text", "compare ../in/few.csv ../in/few.csv"),
        ("sweep-no-truth", "sweep ../in/layouts/kitti-object -o s --vary iterations=0,1"),
        ("eval-no-file", "eval none.png ../in/small/gt.png"),
        ("eval-bad-crop", "eval ../in/small/gt.png ../in/small/gt.png --crop 1,2,3"),
        ("eval-perfect", "eval ../in/small/gt.png ../in/small/gt.png"),
        unordered=True,
    )
